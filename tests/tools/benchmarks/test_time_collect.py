"""The tool collects real rounds and writes what it measured."""

from __future__ import annotations

import csv
from pathlib import Path

from tools.benchmarks.time_collect import main


def test_measures_and_writes(tmp_path: Path) -> None:
    out = tmp_path / "deeper" / "c.csv"
    small = ["task=pendulum", "+experiment=debug", "num_envs=4", "device=cpu"]
    assert (
        main(["--rounds", "2", "--kinds", "inline", "process", "--workers", "2", "--set", *small, "--out", str(out)])
        == 0
    )
    rows = list(csv.DictReader(out.open()))
    assert [(row["collector"], row["workers"]) for row in rows] == [("inline", "1"), ("process", "2")]
    for row in rows:
        assert int(row["steps"]) == 4 * int(rows[0]["steps"]) // 4 and float(row["steps_per_s"]) > 0
        assert 50 < int(row["bytes_per_step"]) < 2000 and int(row["weights_bytes"]) > 1000
