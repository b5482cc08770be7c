# SPDX-License-Identifier: Apache-2.0
"""Every OpenCRG file at hand: read with the OpenCRG library's own values, or refused by name and fault."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from suspension_twin.errors import InputError
from suspension_twin.road import Road, load_road

ASAM, CHRONO = "ASAM_OpenCRG", "projectchrono/crg_roads"
REFUSED = {
    "belgian_block_CORRUPT_5_bytes_lost.crg": "5 bytes are missing",
    "handmade_platform.crg": "grid_nan_mode: '2.000000000+e00' is not a number",
    "testOptionBorderMode.crg": "handmade_sloped_opt.crg, which does not exist",
}
READ = [
    *(f"{ASAM}/crg-txt/fileref{s}.crg" for s in ("", "_mods", "_opts")),
    *(f"{ASAM}/crg-txt/handmade_{s}.crg" for s in ("arc", "banked", "circle", "curved", "sloped", "vtest")),
    *(
        f"{ASAM}/crg-txt/handmade_{s}.crg"
        for s in ("curved_banked_sloped", "curved_minimalist", "sloped_opts")
    ),
    *(f"{ASAM}/crg-txt/handmade_straight{s}.crg" for s in ("", "_double", "_minimalist")),
    f"{ASAM}/belgian_block.crg",
    f"{CHRONO}/Horstwalde.crg",
    *(f"{CHRONO}/detrended_rms_course_{s}in.crg" for s in ("1", "1p5", "2", "3", "4")),
    *(f"{CHRONO}/halfround_{s}in.crg" for s in (2, 4, 6, 8, 10, 12)),
]


def test_every_file_is_in_one_of_the_lists(shared_data: Path) -> None:
    files = {p.name for folder in (ASAM, CHRONO) for p in (shared_data / folder).rglob("*.crg")}
    assert files == {Path(name).name for name in READ} | set(REFUSED)


@pytest.mark.parametrize("name", READ)
def test_values_are_the_librarys(
    shared_data: Path, reference: Callable[[Path], Any], name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    road = load_road(shared_data / name)
    assert capfd.readouterr() == ("", "")
    crg = reference(shared_data / name)
    rng = np.random.default_rng(7)
    u0, u1, v0, v1 = crg.span
    # A tenth of the road's length and a third of its width beyond every border.
    u = rng.uniform(u0 - 0.1 * (u1 - u0), u1 + 0.1 * (u1 - u0), 4000)
    v = rng.uniform(v0 - 0.3 * (v1 - v0), v1 + 0.3 * (v1 - v0), 4000)
    expected = crg.z_uv(u, v)
    given = np.isfinite(expected)
    samples = road.sample_uv(u, v)
    np.testing.assert_allclose(samples.z[given], expected[given], rtol=0, atol=1e-12)
    within = (u >= u0) & (u <= u1) & (v >= v0) & (v <= v1)
    np.testing.assert_array_equal(samples.inside, within & given)

    x, y = crg.to_xy(u, v)
    np.testing.assert_allclose(road.uv_to_xy(u, v), (x, y), rtol=0, atol=1e-11)
    np.testing.assert_allclose(road.xy_to_uv(x, y), crg.to_uv(x, y), rtol=0, atol=1e-9)
    expected = crg.z_xy(x, y)
    given = np.isfinite(expected)
    np.testing.assert_allclose(road.heights(x, y)[given], expected[given], rtol=0, atol=1e-9)
    assert np.isfinite(road.heights(x, y)).all()


@pytest.mark.parametrize("name", READ)
def test_nodes_and_borders_are_the_librarys(
    shared_data: Path, reference: Callable[[Path], Any], name: str
) -> None:
    road = load_road(shared_data / name)
    crg = reference(shared_data / name)
    u, v = np.meshgrid(road.u[:: max(1, road.u.size // 200)], road.v, indexing="ij")
    expected = crg.z_uv(u.ravel(), v.ravel()).reshape(u.shape)
    given = np.isfinite(expected)
    np.testing.assert_allclose(road.heights_uv(u, v)[given], expected[given], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_damaged_files_are_refused_in_one_line(
    shared_data: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = next((shared_data / ASAM).rglob(name))
    with pytest.raises(InputError) as caught:
        load_road(path)
    text = str(caught.value)
    assert name in text
    assert REFUSED[name] in text
    assert "\n" not in text
    assert capfd.readouterr() == ("", "")


def test_a_reference_needs_no_particular_working_folder(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    road = load_road(shared_data / ASAM / "crg-txt" / "fileref.crg")
    assert road.z.shape == (23, 7)


def test_missing_heights_stay_missing_where_the_modifiers_say_so(shared_data: Path) -> None:
    kept = load_road(shared_data / ASAM / "crg-txt" / "fileref.crg")  # an empty section: no modifier
    filled = load_road(shared_data / ASAM / "crg-txt" / "fileref_mods.crg")
    assert np.isnan(kept.z).sum() == 3
    assert not np.isnan(filled.z).any()
    i, j = (int(k[0]) for k in np.nonzero(np.isnan(kept.z)))
    u, v = float(kept.u[i]), float(kept.v[j])
    assert not kept.sample_uv(u, v).inside
    # Held where there is nothing, as the default modifier would have it.
    assert kept.heights_uv(u, v) == pytest.approx(filled.heights_uv(u, v), abs=1e-12)
    assert kept.heights_uv(u, v, "zero") == 0.0
    with pytest.raises(InputError, match="data are missing"):
        kept.heights_uv(u, v, "error")


def _damaged(raw: bytes, rng: np.random.Generator) -> bytes:
    """A file with one accident: bytes changed, lost, doubled, or the end cut off."""
    data = bytearray(raw)
    at = int(rng.integers(0, len(data)))
    size = int(rng.integers(1, 40))
    accident = rng.integers(0, 4)
    if accident == 0:
        data[at : at + size] = rng.integers(0, 256, size, dtype=np.uint8).tobytes()
    elif accident == 1:
        del data[at : at + size]
    elif accident == 2:
        data[at:at] = data[at : at + size]
    else:
        del data[at:]
    return bytes(data)


_FUZZ = """
import sys
from pathlib import Path
import numpy as np
from suspension_twin.errors import InputError
from suspension_twin.road import load_road
read = refused = 0
for path in sorted(Path(sys.argv[1]).glob("*.crg")):
    print(path.name, flush=True)
    try:
        road = load_road(path)
    except InputError as error:
        assert path.name in str(error) and "\\n" not in str(error), str(error)
        refused += 1
        continue
    try:
        u = np.linspace(road.u_first - 1, road.u_last + 1, 300)
        assert np.isfinite(road.heights_uv(u, 0.3 * np.sin(u))).all(), path
    except InputError:
        pass  # the accident made an option that refuses positions beyond the border
    read += 1
print("done", read, refused)
"""


def test_no_accident_to_a_file_ends_the_process_or_gives_a_nan(shared_data: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    count = 0
    for name in READ[:15]:
        raw = (shared_data / name).read_bytes()
        for _ in range(12):
            (tmp_path / f"accident_{count:03d}.crg").write_bytes(_damaged(raw, rng))
            count += 1
    shutil.copy(shared_data / ASAM / "crg-txt" / "handmade_curved_banked_sloped.crg", tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", _FUZZ, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ,
    )
    assert done.returncode == 0, done.stdout[-200:] + done.stderr[-2000:]
    word, read, refused = done.stdout.splitlines()[-1].split()
    assert word == "done"
    assert int(read) + int(refused) == count + 1
    assert int(refused) > count // 4


def test_a_road_keeps_its_arrays_to_itself(shared_data: Path) -> None:
    road: Road = load_road(shared_data / CHRONO / "Horstwalde.crg")
    with pytest.raises(ValueError, match="read-only"):
        road.z[0, 0] = 1.0
