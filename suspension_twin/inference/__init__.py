# SPDX-License-Identifier: Apache-2.0
"""Inference: observations, parameters and the problem that calibration, diagnosis and planning share."""
