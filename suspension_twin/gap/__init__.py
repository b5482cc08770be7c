# SPDX-License-Identifier: Apache-2.0
"""Preparing a drive for comparison and measuring the gap between vehicle and twin."""
