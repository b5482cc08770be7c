# SPDX-License-Identifier: Apache-2.0
"""Shared parts of the sources: connections, clocks, the hub that pairs and merges samples, the server."""
