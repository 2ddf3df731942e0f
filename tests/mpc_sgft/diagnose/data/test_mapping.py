"""Columns of other names, units and signs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.mapping import Source, mapped, parse_mapping, read_mapping
from mpc_sgft.diagnose.data.measured import Table


def test_units_signs_and_offsets() -> None:
    told = "time=t ms, qpos/a=enc deg,ctrl/m=-0.11*current,qvel/a=w rpm,qpos/b=-pos mm + 0.5, force/m=2e-3*i q - 1"
    found = read_mapping(told)
    assert found["time"] == Source("t", 1e-3, 0.0)
    assert found["qpos/a"] == Source("enc", pytest.approx(np.pi / 180), 0.0)
    assert found["ctrl/m"] == Source("current", -0.11, 0.0)
    assert found["qvel/a"] == Source("w", pytest.approx(2 * np.pi / 60), 0.0)
    assert found["qpos/b"] == Source("pos", pytest.approx(-1e-3), 0.5)
    assert found["force/m"] == Source("i q", 2e-3, -1.0)  # q is no unit, so it is part of the name


def test_a_table_gets_our_columns_and_keeps_the_others() -> None:
    table = Table("run", {"t": np.array([0.0, 10.0]), "enc": np.array([180.0, 90.0]), "temperature": np.zeros(2)})
    out = mapped(table, parse_mapping({"time": "t ms", "qpos/a": "enc deg"}))
    assert list(out.columns) == ["temperature", "time", "qpos/a"]
    assert out.columns["time"] == pytest.approx([0, 0.01]) and out.columns["qpos/a"] == pytest.approx(
        [np.pi, np.pi / 2]
    )


def test_a_yaml_file(tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("time: t us\nqpos/a: 'angle of joint, raw deg'\n")
    assert read_mapping(str(path)) == {
        "time": Source("t", 1e-6, 0.0),
        "qpos/a": Source("angle of joint, raw", pytest.approx(np.pi / 180), 0.0),
    }


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("elbow=enc deg", "our columns are time, ctrl/"),
        ("qpos/a=", "write qpos/a="),
        ("no_such.yaml", "no such file"),
    ],
)
def test_mappings_that_cannot_be(given: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        read_mapping(given)


@pytest.mark.parametrize("text", ["- a\n", "qpos/a: 3\n", "{", "a: [\n"])
def test_files_that_cannot_be(text: str, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(UserError, match=r"not yaml|lines such as"):
        read_mapping(str(tmp_path / "map.yaml"))


def test_a_column_that_is_not_there_is_told_with_the_nearest() -> None:
    table = Table("run", {"time": np.zeros(2), "encoder": np.zeros(2)})
    with pytest.raises(UserError, match="no column 'encodr'. Is it 'encoder'"):
        mapped(table, parse_mapping({"qpos/a": "encodr deg"}))


def test_spaces_after_a_minus_are_no_part_of_the_name() -> None:
    assert parse_mapping({"qpos/a": "- enc deg"}) == {"qpos/a": Source("enc", pytest.approx(-np.pi / 180), 0.0)}


@pytest.mark.parametrize("source", ["enc*2", "enc deg+0.1", "enc deg -0.1"])
def test_what_looks_like_a_formula_is_told_its_form(source: str) -> None:
    table = Table("run", {"time": np.zeros(2), "enc": np.zeros(2)})
    with pytest.raises(UserError, match=re.escape("Write qpos/a=[FACTOR*]COLUMN[ UNIT][ + OFFSET], such as qpos/a=-2")):
        mapped(table, parse_mapping({"qpos/a": source}))
    named = mapped(replace(table, columns={"time": np.zeros(2), source: np.ones(2)}), parse_mapping({"qpos/a": source}))
    assert named.columns["qpos/a"] == pytest.approx(1.0)  # unless it is a name


@pytest.mark.parametrize("source", ["1.2.3*x", ".*x", "x + 1.2.3"])
def test_what_is_no_number_belongs_to_the_name(source: str) -> None:
    table = Table("run", {"time": np.zeros(2), "x": np.zeros(2)})
    with pytest.raises(UserError, match=re.escape(f"no column '{source}'")):
        mapped(table, parse_mapping({"qpos/a": source}))
