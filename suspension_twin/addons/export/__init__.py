# SPDX-License-Identifier: Apache-2.0
"""A twin in the files of other simulators."""
