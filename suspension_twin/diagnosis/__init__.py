# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of the sim-to-real gap: where it is, which missing effect is to blame, how far it shrinks."""
