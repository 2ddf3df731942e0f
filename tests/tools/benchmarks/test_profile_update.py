"""The shares of an update's operations add up, and products are among them."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tools.benchmarks import profile_update


def test_shares_add_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profile_update, "keep_freed_memory", lambda: False)  # this process is not ours to change
    out = tmp_path / "p.csv"
    assert profile_update.main(["--sizes", "small", "--precisions", "float32", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert sum(float(row["share"]) for row in rows) == pytest.approx(1, abs=0.01)
    largest = rows[0]
    assert (
        largest["operation"] == "products"
        and 50 < int(largest["calls"]) < 300
        and rows[-1]["operation"] == "everything else"
    )
