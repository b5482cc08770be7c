# SPDX-License-Identifier: Apache-2.0
"""Roads that several tests look at, and the OpenCRG library's own answers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycrg
import pytest
from numpy.typing import NDArray

from suspension_twin.road import Road, grid_road

Floats = NDArray[np.float64]


class Answers(NamedTuple):
    """What the OpenCRG library says; NaN where it has no height."""

    z_uv: Callable[[Floats, Floats], Floats]
    z_xy: Callable[[Floats, Floats], Floats]
    to_uv: Callable[[Floats, Floats], tuple[Floats, Floats]]
    to_xy: Callable[[Floats, Floats], tuple[Floats, Floats]]
    span: tuple[float, float, float, float]


@pytest.fixture
def reference() -> Iterator[Callable[[Path], Answers]]:
    """Opens a file with the OpenCRG library itself, without its memory of earlier queries."""
    opened = []
    logger = logging.getLogger("pycrg")
    before = logger.level
    logger.setLevel(logging.CRITICAL)

    def open_file(path: Path) -> Answers:
        data = pycrg.DataSet.open(path)
        opened.append(data)
        point = data.create_contact_point()
        # With a memory the library starts its search where the last query was.
        point.set_history(0)
        return Answers(
            point.uv_to_z_many,
            point.xy_to_z_many,
            point.xy_to_uv_many,
            point.uv_to_xy_many,
            (*data.u_range(), *data.v_range()),
        )

    yield open_file
    for data in opened:
        data.close()
    logger.setLevel(before)


@pytest.fixture(scope="session")
def wavy() -> Road:
    """20 m by 3 m of waves along and across, unevenly spaced long sections, placed askew in map."""
    v = np.array([-1.5, -1.0, -0.75, 0.0, 0.4, 1.5])
    u = 0.1 * np.arange(201)
    z = 0.05 * np.sin(2 * np.pi * u[:, None] / 3 + v) + 0.02 * v
    return grid_road(z, 0.1, v, x=100.0, y=-40.0, heading=0.6, name="wavy")
