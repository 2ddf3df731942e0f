"""Checkpoints are ranked by what they do in simulation and by how strange reality looks to them."""

import csv
from pathlib import Path

import pytest
import torch

from mpc_sgft.deploy import main as deploy
from mpc_sgft.runs.build import shipped
from mpc_sgft.storage import checkpoint
from tools.studies import vsdr


def test_the_distance_is_in_standard_deviations() -> None:
    torch.manual_seed(0)
    shape = torch.tensor([[2.0, 0.0], [1.0, 0.5]], dtype=torch.float64)
    reference = torch.randn(20_000, 2, dtype=torch.float64) @ shape.T + 3
    far = torch.tensor([[4.0, 0.0], [0.0, 1.0]], dtype=torch.float64) @ shape.T + 3
    assert vsdr.mahalanobis(reference, far).tolist() == pytest.approx([4.0, 1.0], rel=0.03)


def test_both_halves_count_alike() -> None:
    rows = [
        {"name": n, "sim_success": s, "distance": d} for n, s, d in (("a", 1.0, 4.0), ("b", 0.9, 1.0), ("c", 0.0, 4.0))
    ]
    vsdr.rank(rows)
    assert [(r["rank"], r["name"]) for r in rows] == [(1, "b"), (2, "a"), (3, "c")]
    for r, success in zip(rows, (0.8, 0.5, 0.1), strict=True):
        r["gap_success"] = success
    assert vsdr.foretells(rows, "score") == 1.0 and vsdr.foretells(rows, "distance") > 0


def test_a_checkpoint_that_forgot_comes_last(tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    words = ["task=push", "method=zero_shot", "rollouts=1", "eval_episodes=1", "log.rerun=false", "quiet=true"]
    assert deploy([*words, f"run_dir={run}"]) == 0
    good, bad = shipped("push"), tmp_path / "bad.safetensors"
    save_noisy(good, bad)
    out = tmp_path / "ranking.csv"
    line = [str(out), "--run", str(run), "--checkpoints", str(bad), str(good), "--episodes", "8", "--gap", "none"]
    assert vsdr.main(line) == 0
    first, second = csv.DictReader(out.open())
    assert (first["checkpoint"], second["checkpoint"]) == (str(good), str(bad))
    assert float(first["gap_success"]) > float(second["gap_success"])
    assert "foretells none: score 1.00" in capsys.readouterr().out


def save_noisy(source: Path, target: Path) -> None:
    """A checkpoint with a policy and a reward that mean nothing."""
    torch.manual_seed(0)
    model, meta = checkpoint.load(source, tasks=["push"])[:2]
    with torch.no_grad():
        for part in (model.reward_head, model.policy_head):
            for x in part.parameters():
                x.normal_()
    checkpoint.save(target, model, meta)


def test_a_folder_without_episodes_says_so(tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        vsdr.main([str(tmp_path / "x.csv"), "--run", str(tmp_path), "--checkpoints", "a", "b"])
    assert stop.value.code == 2 and "no config.yaml in it" in capsys.readouterr().err
