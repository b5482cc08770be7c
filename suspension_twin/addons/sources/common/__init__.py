# SPDX-License-Identifier: Apache-2.0
"""What all sources share: addresses, clocks, pairing of streams, the hub that samples go to, the server."""
