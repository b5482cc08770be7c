# SPDX-License-Identifier: Apache-2.0
"""The rows of ``torture.py``: one module each, with what a trial does and what counts as failure."""
