"""The benchmark of a GPU runs on a processor too, and says so where there is no GPU."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch

from tools.benchmarks import gpu_bench


def test_it_writes_a_row_for_everything(tmp_path: Path) -> None:
    out = tmp_path / "bench.csv"
    words = ["--device", "cpu", "--sizes", "small", "--envs", "2", "--physics", "mujoco", "--repeats", "1"]
    assert gpu_bench.main([*words, "--out", str(out)]) == 0
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["what"], row["precision"]) for row in rows] == [
        ("plan", "float32"), ("update", "float32"), ("plan", "bfloat16"), ("update", "bfloat16"),
        ("environment steps", "float64"),
    ]  # fmt: skip
    assert all(float(row["median_ms"]) > 0 and row["device"] for row in rows)
    assert float(rows[-1]["per_second"]) == pytest.approx(80e3 / float(rows[-1]["median_ms"]), rel=0.1)


def test_fine_tuning_is_measured_once_on_a_processor(tmp_path: Path) -> None:
    out = tmp_path / "bench.csv"
    few = ["rollouts=1", "eval_every=1", "eval_episodes=1", "method.updates=1", "method.gate=false", "log.rerun=false"]
    words = ["--device", "cpu", "--sizes", "--envs", "0", "--deploy", str(tmp_path / "runs"), "--out", str(out)]
    assert gpu_bench.main([*words, "--settings", *few]) == 0
    with out.open(newline="") as file:
        (row,) = csv.DictReader(file)
    done = json.loads((tmp_path / "runs/cpu/summary.json").read_text())
    assert row["what"] == "fine-tune push" and row["count"] == "1" and row["device"]
    assert float(row["median_ms"]) == 1e3 * done["wall_seconds"] and float(row["success"]) == done["final_success"]
    assert row["parts_s"] == ", ".join(f"{part} {spent}" for part, spent in done["seconds"].items())


def test_without_a_gpu_it_says_so(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="2"):
        gpu_bench.main([])
    assert "--device cpu" in capsys.readouterr().err
