# SPDX-License-Identifier: Apache-2.0
"""What the importers share: files in folders and archives, tables of text, clocks, streams."""
