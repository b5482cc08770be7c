# SPDX-License-Identifier: Apache-2.0
"""Manifests in CSV and in YAML, and the line for each error in one."""

from __future__ import annotations

from pathlib import Path

import pytest

from suspension_twin.addons.fleet.manifest import read_manifest
from suspension_twin.errors import InputError


def test_csv_and_yaml_say_the_same(tmp_path: Path) -> None:
    table, tree = tmp_path / "fleet.csv", tmp_path / "fleet.yaml"
    table.write_text(
        "vehicle,date,twin,drives,references,road\n"
        "a,2026-03-01,twins/a.yaml,one; s3://bucket/two.mcap,ref,\n"
        f"b,,file://{tmp_path}/my%20twin.yaml,three,,s3://bucket/road.crg\n"
    )
    tree.write_text(
        "items:\n"
        "  - {vehicle: a, date: 2026-03-01, twin: twins/a.yaml, drives: [one, 's3://bucket/two.mcap'],"
        " references: ref}\n"
        f"  - {{vehicle: b, twin: 'file://{tmp_path}/my%20twin.yaml', drives: three, road: 's3://bucket/road.crg'}}\n"
    )
    first, second = found = read_manifest(table)
    assert read_manifest(tree) == found
    assert first.drives == (str(tmp_path / "one"), "s3://bucket/two.mcap")
    assert (first.references, first.road) == ((str(tmp_path / "ref"),), "")
    assert (second.twin, second.date) == (str(tmp_path / "my twin.yaml"), "")


def test_defaults_hold_for_every_item_without_a_value_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yml"
    path.write_text(
        "defaults: {twin: t.yaml}\nitems: [{vehicle: 1, drives: a}, {vehicle: 2, drives: b, twin: u.yaml}]\n"
    )
    assert [Path(i.twin).name for i in read_manifest(path)] == ["t.yaml", "u.yaml"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("vehicle,twin\na,t\n", "header: drives is missing"),
        ("vehicle,twin,drives,rode\na,t,d,r\n", "header: 'rode' is not one of .*, did you mean road"),
        ("vehicle,twin,drives\n,t,d\n", "line 2: vehicle is empty"),
        ("vehicle,twin,drives\na,t,d,e\n", "line 2: has more values than the header has columns"),
        ("vehicle,date,twin,drives\na,1.3.2026,t,d\n", "line 2: date: YYYY-MM-DD is expected, is '1.3.2026'"),
        ("vehicle,twin,drives\na,t,d\na,t,d\n", "line 3: is the same vehicle, date and drives as line 2"),
        ("vehicle,twin,drives\n", "holds no drives"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "fleet.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"fleet\.csv: {line}"):
        read_manifest(path)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[]", "items: a list"),
        ("items: [3]", r"items\.0: must be keys and values"),
        ("items: [{vehicle: a, twin: t, drives: [1]}]", r"items\.0: drives: names of recordings"),
        ("itmes: []\nitems: []", "'itmes': is not a key of a manifest"),
    ],
)
def test_a_wrong_tree_is_one_line(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"fleet\.yaml: {line}"):
        read_manifest(path)
