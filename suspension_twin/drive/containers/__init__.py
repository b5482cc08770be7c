# SPDX-License-Identifier: Apache-2.0
"""Recordings as raw messages: one reader for each file format, all of them read what is whole."""
