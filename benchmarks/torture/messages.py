# SPDX-License-Identifier: Apache-2.0
"""The running twin under messages and requests that nobody should send."""

from __future__ import annotations

import math
import struct

import numpy as np

from torture.ledger import Tally
from torture.watch import Twin, stamped, watched

__all__ = ["BAR", "torture"]

BAR = "no node dies, nothing published that is not finite, memory flat, an answer within 1 s of the last bad stamp"

NUMBERS = [math.nan, math.inf, -math.inf, 1.8e308, -1e300, 1e30, 5e-324, 0.0, -0.0, 1e9, -1e9]
_LATE = 1_000_000_000  # ns by which a stamp may go back without a reset
_STAMPS = [(0, 0), (-1, 0), (-(1 << 31), 0), ((1 << 31) - 1, 999_999_999), (1 << 30, 0xFFFFFFFF), (5, 5)]


def _bad(rng: np.random.Generator, data: bytes, now: int) -> bytes:
    """A message that no sensor sends."""
    kind = int(rng.integers(6))
    if kind == 0:  # cut off
        return data[: int(rng.integers(len(data)))]
    if kind == 1:  # bits
        changed = bytearray(data)
        for _ in range(int(rng.integers(1, 30))):
            changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    if kind == 2:
        sec, nanosec = _STAMPS[int(rng.integers(len(_STAMPS)))]
        return data[:4] + struct.pack("<iI", sec, nanosec) + data[12:]
    if kind == 3:
        data = stamped(data, max(now + int(rng.normal(0, 1e9) * 10.0 ** rng.integers(0, 6)), 0))
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):  # doubles follow the header
        begin = len(changed) - 8 * int(rng.integers(1, 30))
        if begin > 12:
            changed[begin : begin + 8] = struct.pack("<d", NUMBERS[int(rng.integers(len(NUMBERS)))])
    if kind == 5:
        changed[16:20] = struct.pack("<I", int(rng.choice([0, 1, 1 << 20, (1 << 32) - 1])))
        return bytes(changed)
    return bytes(changed) if kind == 3 else stamped(bytes(changed), now)


def _calls(twin: Twin, rng: np.random.Generator) -> None:
    """Services with what nobody should ask for; the answers are taken as they come."""
    from std_srvs.srv import Trigger

    from suspension_twin_interfaces.srv import LoadTwin, SetDatum

    if not twin.clients:
        services = ((Trigger, "reset"), (LoadTwin, "load_twin"))
        twin.clients = [twin.node.create_client(kind, f"suspension_model/{name}") for kind, name in services]
        twin.clients.append(twin.node.create_client(SetDatum, "pose_injector/set_datum"))
    client = twin.clients[int(rng.integers(len(twin.clients)))]
    request = client.srv_type.Request()
    for name, kind in request.get_fields_and_field_types().items():
        if kind == "string":
            setattr(request, name, str(rng.choice(["", "/dev/zero", "x" * 100_000, "[/b]\n", "/etc/passwd"])))
        elif kind in ("double", "float"):
            setattr(request, name, float(rng.choice(NUMBERS[:6])))
        elif "GeoPoint" in kind or hasattr(getattr(request, name), "latitude"):
            getattr(request, name).latitude = math.nan
    if client.service_is_ready():
        client.call_async(request)


def torture(tally: Tally) -> None:
    """Five hundred bad messages and two calls a trial.

    After a stamp that is ahead by up to a second what follows is late, and dropped until time has caught up.
    """

    def trial(twin: Twin, rng: np.random.Generator, number: int) -> tuple[str, float]:
        names, clean = list(twin.samples), twin.time + 600_000_000
        stamps = [0]  # ns ahead of the first clean one
        for k in range(500):
            name = names[int(rng.integers(len(names)))]
            data = twin.samples[name][int(rng.integers(len(twin.samples[name])))]
            data = _bad(rng, data, twin.time + k * 1_000_000)
            twin.send(name, data)
            if len(data) >= 12:
                sec, nanosec = struct.unpack("<iI", data[4:12])
                stamps.append(sec * 1_000_000_000 + nanosec - clean)
            if k % 50 == 0:
                twin.listen(0.01)
        for _ in range(2):
            _calls(twin, rng)
        twin.listen(0.1)
        twin.time = clean
        return "500 bad messages", max(s for s in stamps if s <= _LATE) / 1e9

    watched(tally, trial)
