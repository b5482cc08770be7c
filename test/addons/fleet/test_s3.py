# SPDX-License-Identifier: Apache-2.0
"""A fleet in object storage, against an S3 server: the same results as from files here.

Needs s3fs and moto, whose botocore does not go with every release of python-dateutil: an environment of its own.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest

from suspension_twin.addons.fleet.storage import identity, outline
from suspension_twin.cli.main import main

_MISSING = "no S3 here: pip install s3fs moto[server]"
s3fs = pytest.importorskip("s3fs", reason=_MISSING)
pytest.importorskip("moto.server", reason=_MISSING)

CHEAP = ("--max-generations", "1", "--freeze", "vehicle.front.spring", "--freeze", "vehicle.rear.spring")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """The address of an S3 server with an empty bucket ``fleet``."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stderr=subprocess.DEVNULL
    )
    try:
        until = time.monotonic() + 60.0
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def store(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """The bucket, reached as a user reaches it: by the environment's address and credentials."""
    given = {"AWS_ENDPOINT_URL": server, "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x"}
    for name, value in (given | {"AWS_DEFAULT_REGION": "us-east-1"}).items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    fs = s3fs.S3FileSystem()
    if not fs.exists("fleet"):
        fs.mkdir("fleet")
    yield fs
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.usefixtures("in_this_process")
def test_a_fleet_in_a_store_gives_what_it_gives_here(
    store: object, fleet_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fs = store
    folder = fleet_folder / "one"
    mcap = next(folder.glob("*.mcap"))
    fs.put(str(folder), "fleet/one", recursive=True)  # type: ignore[attr-defined]
    fs.put_file(str(mcap), "fleet/bare/two.mcap")  # type: ignore[attr-defined]
    fs.put_file(str(fleet_folder / "road.crg"), "fleet/twins/road.crg")  # type: ignore[attr-defined]
    text = (fleet_folder / "twin.yaml").read_text().replace(str(fleet_folder / "road.crg"), "road.crg")
    fs.pipe_file("fleet/twins/twin.yaml", text.encode())  # type: ignore[attr-defined]
    assert outline("s3://fleet/one").date == outline("s3://fleet/bare/two.mcap").date == "2023-11-14"

    there, here = tmp_path / "there.csv", tmp_path / "here.csv"
    there.write_text(
        "vehicle,twin,drives\n"
        "folder,s3://fleet/twins/twin.yaml,s3://fleet/one\n"
        "file,s3://fleet/twins/twin.yaml,s3://fleet/bare/two.mcap\n"
        "none,s3://fleet/twins/twin.yaml,s3://fleet/absent.mcap\n"
    )
    here.write_text(f"vehicle,twin,drives\nfolder,{fleet_folder / 'twin.yaml'},{folder}\n")
    assert main(["fleet", "calibrate", str(there), "--out", str(tmp_path / "a"), *CHEAP]) == 1
    assert "s3://fleet/absent.mcap: No such file or directory" in capsys.readouterr().out
    assert main(["fleet", "calibrate", str(here), "--out", str(tmp_path / "b"), *CHEAP]) == 0
    query = "SELECT status, date, gap_after, parameters, places FROM '{}/results.parquet' ORDER BY vehicle"
    rows = duckdb.sql(query.format(tmp_path / "a")).fetchall()
    (wanted,) = duckdb.sql(query.format(tmp_path / "b")).fetchall()
    assert wanted[0] == "done" and [r == wanted for r in rows] == [True, True, False]

    capsys.readouterr()
    assert main(["fleet", "calibrate", str(there), "--out", str(tmp_path / "a"), *CHEAP]) == 1
    assert "none computed now" in capsys.readouterr().out
    before = identity("s3://fleet/bare/two.mcap")
    fs.pipe_file("fleet/bare/two.mcap", mcap.read_bytes()[:-1])  # type: ignore[attr-defined]
    s3fs.S3FileSystem.clear_instance_cache()
    assert identity("s3://fleet/bare/two.mcap") != before
