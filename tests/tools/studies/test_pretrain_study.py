"""A row says what a pretraining came to, where its seconds went and what memory it took."""

import csv
import json
import sys

from tools.studies import pretrain_study


def test_runs_that_are_there_become_rows(tmp_path, monkeypatch):
    summary = {"task": "push", "seed": 5, "transitions": 320, "updates": 16, "episodes_evaluated": 4, "success": 0.75}
    summary |= {"success_interval": [0.3006, 0.9544], "prior_success": 0.5, "wall_seconds": 9.5}
    summary |= {"seconds": {"wait": 1.5, "update": 4.0, "evaluate": 3.0, "save": 0.25, "physics": 2.0, "act": 0.5}}
    summary |= {"peak_memory_mb": {"learner": 900, "collector": 800}}
    (tmp_path / "push-5").mkdir()
    (tmp_path / "push-5" / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "push-5.asked").write_text("pretrain\ntask=push\nseed=5\n")
    words = ["--csv", str(tmp_path / "out.csv"), "--runs", str(tmp_path), "--seeds", "5"]
    monkeypatch.setattr(sys, "argv", ["pretrain_study", *words])
    pretrain_study.main()
    with (tmp_path / "out.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["success"], row["success_low"], row["success_high"]) == ("0.75", "0.301", "0.954")
    parts = ("update_seconds", "wait_seconds", "evaluate_seconds", "save_seconds", "physics_seconds", "act_seconds")
    assert [float(row[name]) for name in parts] == [4.0, 1.5, 3.0, 0.25, 2.0, 0.5]
    assert (row["learner_mb"], row["collector_mb"]) == ("900", "800")
