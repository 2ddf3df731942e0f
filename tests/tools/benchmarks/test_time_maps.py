"""Each way of deploying has the maps that its name says, and is timed."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from mpc_sgft.command.compose import compose
from tools.benchmarks import time_maps


def test_each_way_has_one_map_more() -> None:
    on = [[compose("deploy", words, []).method[key] for key in ("command_map", "command_band", "observation_map")]
          for words in time_maps.WAYS.values()]  # fmt: skip
    assert [sum((a, a and b, c)) for a, b, c in on] == [0, 1, 2, 3]


def test_a_row_for_every_way_and_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_maps, "keep_freed_memory", lambda: False)  # this process is not ours to change
    monkeypatch.setattr(time_maps, "CALLS", 1)
    monkeypatch.setattr(time_maps, "EPISODES", 2)
    monkeypatch.setattr(time_maps, "WAYS", {k: time_maps.WAYS[k] for k in ("none", "command")})
    out = tmp_path / "maps.csv"
    assert time_maps.main(["--repeats", "1", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [(r["maps"], r["what"]) for r in rows] == [(m, w) for m in ("none", "command") for w in ("update", "plan")]
    assert all(float(r["ms"]) > 0 for r in rows) and {r["to_none"] for r in rows[:2]} == {"1.0"}
