# SPDX-License-Identifier: Apache-2.0
"""Add-ons: live sources, roads from scans and drives, fleets, exports, the live view. The core imports none of them."""
