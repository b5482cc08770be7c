# SPDX-License-Identifier: Apache-2.0
"""Nodes of the add-ons: live sources, the road learner, the page, Foxglove. They alone in ``addons`` import ROS."""
