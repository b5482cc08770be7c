# SPDX-License-Identifier: Apache-2.0
"""Live mixed-reality twins of a vehicle's suspension for ROS 2, calibrated from recorded drives."""

__version__ = "0.2.0"
