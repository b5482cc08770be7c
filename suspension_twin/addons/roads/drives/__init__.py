# SPDX-License-Identifier: Apache-2.0
"""The road under the wheels, estimated from drives with a calibrated vehicle."""
