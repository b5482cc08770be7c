# SPDX-License-Identifier: Apache-2.0
"""Who may speak to the page, small files that would cost much, floods of connections, and what a ROS peer may name."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import subprocess
import tempfile
import time
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from torture.commands import PROGRAM, ROOT, environment
from torture.ledger import Tally

__all__ = ["BARS", "budget", "flood", "peer", "who"]

BARS = {
    "who": "nobody is served without the token, no host but this one with it",
    "budget": "a result or one line with exit 2; below 500 MB and 20 s of processor time for a file below 1 MB",
    "flood": "who has the token is answered within 15 s, and nothing is printed",
    "peer": "no file out of the folders is read or written, and nothing of a file is answered",
}
_MOST_MEMORY, _MOST_SECONDS, _ANSWERED = 500.0, 20.0, 15.0  # MB, s, s

_NAMES = (
    *(
        "127.0.0.1",
        "localhost",
        "[::1]",
        "127.0.0.1.nip.io",
        "evil.example",
        "127.1",
        "0",
        "0x7f000001",
        "2130706433",
    ),
    *(
        "localhost.",
        "foo.localhost",
        "[::ffff:127.0.0.1]",
        "lvh.me",
        "127.0.0.1@evil.example",
        "",
        "\u212a",
        "::1",
    ),
)
_LOCAL = ("127.0.0.1", "localhost", "[::1]")


def _asked(port: int, head: bytes, wait: float = 5.0) -> bytes:
    """The first line of an answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=wait) as connection:
        connection.sendall(head)
        return connection.recv(4096).partition(b"\r\n")[0]


def _server() -> tuple[object, str, int]:
    from suspension_twin.addons.view.live import LiveView
    from suspension_twin.addons.view.server import Server

    server = Server(LiveView(), lambda name, number: "", port=0)
    return server, server.token, server.port


def who(tally: Tally) -> None:
    """Requests with any host, origin, token and path."""
    server, token, port = _server()
    try:
        for number in tally.numbers():
            rng = tally.rng(number)
            host = str(rng.choice(_NAMES)) + rng.choice(["", f":{port}", ":80"])
            given = rng.choice([token, "", token[:-1], token.upper() + "x", token + "&token=x"])
            path = rng.choice(
                ["/", "/ws", "/static/app.js", "/road/0/0", "/report", "/open", "//", "/%2e%2e/x"]
            )
            cookie = rng.choice(["", f"suspension_twin_{port}={rng.choice([token[1:], 'x'])}"])
            origin = rng.choice(["", f"http://{host}", "null", "http://evil.example"])
            head = f"GET {path}?token={given} HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n"
            head += f"Origin: {origin}\r\n" * bool(origin) + "Connection: close\r\n\r\n"
            line = _asked(port, head.encode("utf-8", "replace"))
            allowed = given.partition("&")[0] == token and host.partition(":")[0].lower() in (*_LOCAL, "[")
            served = b" 200 " in line or b" 101 " in line
            tally.count("served" if served else "refused")
            if served and not allowed:
                tally.fail(f"{host!r} with {given!r} got {path}: {line!r}")
    finally:
        server.close()  # type: ignore[attr-defined]


def flood(tally: Tally) -> None:
    """Many half-open connections and requests that are none; then one with the token."""
    server, token, port = _server()
    try:
        for number in tally.numbers():
            rng = tally.rng(number)
            held = []
            for _ in range(int(rng.integers(50, 900))):
                one = socket.socket()
                one.setblocking(False)
                with contextlib.suppress(OSError):
                    one.connect(("127.0.0.1", port))
                with contextlib.suppress(OSError):
                    one.send(
                        rng.choice([b"", b"GET", b"GET / HTTP/1.1\r\nA: ", rng.bytes(200), b"\r\n" * 50])
                    )
                held.append(one)
            began = time.monotonic()
            good = f"GET /?token={token} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
            try:
                line = _asked(port, good.encode(), _ANSWERED)
            except OSError as error:
                line = str(error).encode()
            for one in held:
                one.close()
            tally.count("connections", len(held))
            tally.measure("answered, s", time.monotonic() - began)
            if b" 200 " not in line:
                tally.fail(f"{len(held)} connections: {line!r}")
    finally:
        server.close()  # type: ignore[attr-defined]


# Small files that would cost much


def _element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def _mat5(rng: np.random.Generator) -> bytes:
    dims = [int(2 ** rng.uniform(0, 31)) % (1 << 31) for _ in range(rng.integers(1, 4))]
    flags = _element(6, struct.pack("<II", int(rng.integers(0, 19)), 0))
    body = flags + _element(5, struct.pack(f"<{len(dims)}i", *dims)) + _element(1, b"acceleration")
    body = _element(14, body + rng.bytes(int(rng.integers(0, 200))))
    if rng.random() < 0.5:
        packed = zlib.compress(body + bytes(int(2 ** rng.uniform(0, 27))), 9)
        body = struct.pack("<II", 15, len(packed)) + packed
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + body


def _mat73(rng: np.random.Generator, path: Path) -> None:
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        data = np.zeros((1, int(2 ** rng.uniform(0, 22))))
        inner = file.create_dataset("#refs#/z", data=data, compression="gzip")
        inner.attrs["MATLAB_class"] = np.bytes_("double")
        depth = int(rng.integers(1, 40))
        for k in range(depth):
            width = int(rng.integers(1, 30))
            name = "acceleration" if k == depth - 1 else f"#refs#/{k}"
            outer = file.create_dataset(name, (width, 1), dtype=h5py.ref_dtype)
            for i in range(width):
                outer[i, 0] = inner.ref
            outer.attrs["MATLAB_class"] = np.bytes_("cell")
            inner = outer
        if rng.random() < 0.3:
            file["gyro"] = h5py.ExternalLink("/etc/passwd", "/x")
    with path.open("rb+") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def _profile(rng: np.random.Generator) -> bytes:
    steps = 10.0 ** rng.uniform(-9, 6, int(rng.integers(3, 40)))
    return "\n".join(f"{s!r},0,0" for s in np.cumsum(steps).tolist()).encode()


def _xodr(rng: np.random.Generator) -> bytes:
    length, step = 10.0 ** rng.uniform(-3, 15), 10.0 ** rng.uniform(-6, 3)
    encoding = rng.choice(["utf-8", "nonsense", "utf-7", "utf-16"])
    mode = rng.choice(["attached", "genuine", "global"])
    crg = f'<CRG file="{ROOT}/bags/crg_road/road.crg" mode="{mode}" sOffset="{step}"/>'
    geometry = f'<geometry s="0" x="0" y="0" hdg="0" length="{rng.choice([length, 0.0])}"><line/></geometry>'
    road = f'<road id="1"><planView>{geometry}</planView><surface>{crg}</surface></road>'
    return f'<?xml version="1.0" encoding="{encoding}"?><OpenDRIVE>{road}</OpenDRIVE>'.encode()


def _log(rng: np.random.Generator) -> bytes:
    """A log of a phone with stamps that lie as far apart as numbers go."""
    t = 1.7e9 + np.cumsum(10.0 ** rng.uniform(-9, 9, 200))
    rows = [f"{int(s * 1e9)},{s},0.1,9.8,0.1" for s in t.tolist()]
    return "\n".join(["time,seconds_elapsed,z,y,x", *rows]).encode()


def _costly(rng: np.random.Generator, folder: Path) -> tuple[str, list[str]]:
    """Make a file; its kind and the command that reads it."""
    kind = str(rng.choice(["v5.mat", "v73.mat", "profile.csv", "road.xodr", "Accelerometer.csv"]))
    path = folder / kind
    if kind == "v73.mat":
        _mat73(rng, path)
    else:
        make = {"v5.mat": _mat5, "profile.csv": _profile, "road.xodr": _xodr, "Accelerometer.csv": _log}
        path.write_bytes(make[kind](rng))
    out = str(folder / "out.crg")
    if kind in ("profile.csv", "road.xodr"):
        return kind, ["road", "profile", str(path), "--out", out]
    return kind, ["import", str(path), "--out", str(folder / "out.mcap")]


def budget(tally: Tally) -> None:
    """Files below 1 MB that ask for as much as they can."""
    for number in tally.numbers():
        with tempfile.TemporaryDirectory() as name:
            kind, words = _costly(tally.rng(number), Path(name))
            size = (Path(name) / kind).stat().st_size
            if size > 1 << 20:
                continue
            with (Path(name) / "err").open("w+b") as errors:
                process = subprocess.Popen(
                    [*PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=errors, env=environment()
                )
                _, status, used = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
                errors.seek(0)
                said = errors.read().decode("utf-8", "replace").strip()
            memory, seconds = used.ru_maxrss / 1000, used.ru_utime + used.ru_stime
            tally.count(kind)
            tally.measure("memory, MB", memory)
            tally.measure("time, s", seconds)
            last = said.rpartition("\n")[2]
            if process.returncode not in (0, 2) or "Traceback" in said or "unexpected" in said:
                tally.fail(f"{kind}, {size} bytes: status {process.returncode}: {last}")
            elif memory > _MOST_MEMORY or seconds > _MOST_SECONDS:
                tally.fail(f"{kind}, {size} bytes: {memory:.0f} MB, {seconds:.0f} s")


# Paths of a goal


def peer(tally: Tally) -> None:
    """Goals that name files in and out of the folders, through links, with any ending."""
    from suspension_twin.errors import SuspensionTwinError
    from suspension_twin.files import Folders, for_peers, reading
    from suspension_twin.nodes.jobs import calibration_job, check_paths

    twin = str(ROOT / "bags" / "crg_road" / "twin.yaml")
    with tempfile.TemporaryDirectory() as name:
        own, other = Path(name, "own"), Path(name, "other")
        for folder in (own, other):
            folder.mkdir()
            (folder / "secret.yaml").write_text("swordfish: 1\n")
            (folder / "secret.txt").write_text("swordfish")
        (own / "link.yaml").symlink_to(other / "secret.yaml")
        (own / "out").symlink_to(other)
        kept = {p: p.read_bytes() for p in Path(name).rglob("*") if p.is_file()}
        parts = (
            "own",
            "other",
            "..",
            ".",
            "out",
            "link.yaml",
            "secret.yaml",
            "secret.txt",
            "new.yaml",
            "~",
            "",
        )
        for number in tally.numbers():
            rng = tally.rng(number)

            def path(rng: np.random.Generator = rng) -> str:
                words = "/".join(rng.choice(parts, int(rng.integers(1, 4))))
                return str(
                    rng.choice([f"{name}/{words}", words, f"/{words}", "/etc/shadow", f"{own}/{words}"])
                )

            goal = SimpleNamespace(
                twin=rng.choice(["", twin, path()]), bags=[path()], output=rng.choice(["", path()]), preset="",
                seed=0, free=[], max_generations=1,
            )  # fmt: skip
            said: list[str] = []
            try:
                with reading("calibrate", "a goal"), for_peers(said.append):
                    check_paths(goal, Folders([own]), twin)
                    job = calibration_job(goal, twin, 1)
                    Folders([own]).check(job.output)
                output = Path(job.output).resolve()
                tally.count("taken")
                if not output.is_relative_to(own.resolve()) or output.suffix != ".yaml" or output.exists():
                    tally.fail(f"{json.dumps(vars(goal))} would write {output}")
            except SuspensionTwinError as error:
                tally.count("refused")
                if "swordfish" in str(error):
                    tally.fail(f"{json.dumps(vars(goal))} is answered by {error}")
        if kept != {p: p.read_bytes() for p in Path(name).rglob("*") if p.is_file()}:
            tally.fail("a file has changed")
