# SPDX-License-Identifier: Apache-2.0
"""Roads from point clouds of laser scanners."""
