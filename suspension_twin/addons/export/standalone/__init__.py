# SPDX-License-Identifier: Apache-2.0
"""Kernels of the models written out in C and C#, for targets that run without this package."""
