# SPDX-License-Identifier: Apache-2.0
"""Roads from laser scans and from recorded drives."""
