"""Two commits are timed in turn, each with its own code, and leave no checkout behind."""

import csv
import subprocess

import pytest

from tools.benchmarks import time_commits


def checkouts() -> list[str]:
    line = ["git", "-C", str(time_commits.ROOT), "worktree", "list"]
    return subprocess.run(line, capture_output=True, text=True, check=True).stdout.splitlines()


def test_a_commit_beside_itself(tmp_path):
    there, out = checkouts(), tmp_path / "out.csv"
    words = ["--sizes", "small", "--precisions", "float32", "--rounds", "1", "--out", str(out)]
    assert time_commits.main(["HEAD", *words]) == 0
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["what"] for row in rows] == ["plan", "update"]
    for row in rows:
        assert row["before"] == row["after"] and float(row["before_ms"]) > 0
        assert float(row["ratio"]) == pytest.approx(float(row["after_ms"]) / float(row["before_ms"]), rel=0.1)
    assert checkouts() == there


def test_what_is_no_commit_is_named():
    with pytest.raises(SystemExit, match="nowhere: no commit of this repository"):
        time_commits.main(["nowhere"])
