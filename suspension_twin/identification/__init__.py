# SPDX-License-Identifier: Apache-2.0
"""What calibration and diagnosis share, for every vehicle."""
