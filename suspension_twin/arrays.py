# SPDX-License-Identifier: Apache-2.0
"""The array type that the whole package computes with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Floats"]

Floats = NDArray[np.float64]
