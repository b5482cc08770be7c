# SPDX-License-Identifier: Apache-2.0
"""Recordings as raw messages: whole files through ``rosbags``, damaged ones record by record."""
