# SPDX-License-Identifier: Apache-2.0
"""The page on which a person watches a running twin. No ROS in here: ``nodes/viewer.py`` feeds it."""
