# SPDX-License-Identifier: Apache-2.0
"""The whole way on the bundled drives: live, calibrated, validated, one page."""
