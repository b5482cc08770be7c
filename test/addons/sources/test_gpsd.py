# SPDX-License-Identifier: Apache-2.0
"""A receiver by way of gpsd."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace

import numpy as np
import pytest
from listening import Taken, listen
from receivers import gpsd_lines, serve_lines

from suspension_twin.addons.sources import make_sources
from suspension_twin.addons.sources.common.hub import Hub
from suspension_twin.drive.types import Drive
from suspension_twin.errors import InputError


def hear(lines: list[bytes], fixes: int) -> tuple[Taken, list[bytes]]:
    told_: list[bytes] = []

    async def play(sources, taken) -> None:
        server, port, told = await serve_lines(lines)
        sources[0].address = replace(sources[0].address, port=port)
        while taken.count("fix") < fixes:
            await asyncio.sleep(0.01)
        told_.extend(told)
        server.close()

    return listen("gpsd://127.0.0.1:1", play), told_


def test_a_drive_arrives_as_it_was(bump: Drive) -> None:
    lines = gpsd_lines(bump)
    lines[10:10] = [
        b"not JSON\n",
        b'{"class":"TPV","mode":3,"time":"soon","lat":1,"lon":1}\n',
        b'{"class":"TPV"}\n',
    ]
    taken, told = hear(lines, len(bump.fix))
    assert told == [b'?WATCH={"enable":true,"json":true};\n']
    np.testing.assert_allclose(taken.fix.t, bump.fix.t, atol=6e-4)
    np.testing.assert_allclose(taken.fix.latitude, bump.fix.latitude, atol=1e-12)
    np.testing.assert_allclose(taken.fix.altitude, bump.fix.altitude)
    np.testing.assert_allclose(taken.fix.sigma, bump.fix.sigma)
    np.testing.assert_allclose(taken.velocity.enu, bump.velocity.enu, atol=1e-12)
    assert set(taken.fix.status) == {2}
    assert taken.hub.devices["receiver 127.0.0.1"].counts["reports with a wrong field"] == 2


def epochs(reports: int, first: int, count: int = 12) -> list[bytes]:
    """Of each epoch some reports: the first ones before the altitude is known, the last one with a field less."""
    lines = []
    for k in range(count):
        tpv = {
            "class": "TPV",
            "mode": 2,
            "time": f"2024-05-01T10:00:{k:02d}.000Z",
            "lat": 47.0 + 1e-4 * k,
            "lon": 11.0,
        }
        tpv |= {"speed": 11.1, "track": 0.0}
        whole = tpv | {"mode": 3, "altHAE": 1699.1, "epx": 5.0, "epy": 7.0, "epv": 9.0}
        for i in range(reports):
            lines.append(json.dumps(tpv if i < first else whole).encode() + b"\n")
    return lines


@pytest.mark.parametrize(("reports", "first"), [(1, 0), (3, 1), (4, 2), (4, 0), (2, 2)])
def test_of_an_epoch_that_is_reported_again_the_most_complete_counts(reports: int, first: int) -> None:
    lines = epochs(reports, first)
    lines += epochs(1, 0, 13)[-1:]  # the last epoch ends with the next
    taken, _ = hear(lines, 12)
    fix = taken.fix.select(np.arange(12))
    np.testing.assert_allclose(np.diff(fix.t), 1.0)
    if first < reports:
        assert set(fix.altitude) == {1699.1} and (fix.sigma == [5.0, 7.0, 9.0]).all()
    else:  # none of them knows the altitude
        assert np.isnan(fix.altitude).all()
    assert len(taken.velocity) == len(taken.fix)
    np.testing.assert_allclose(taken.velocity.enu[:, 1], 11.1)


def test_the_port_has_a_default_and_the_host_has_none() -> None:
    (source,) = make_sources(["gpsd://localhost"], Hub())
    assert source.address.port == 2947
    with pytest.raises(InputError, match="names no host"):
        make_sources(["gpsd:/dev/x"], Hub())
