"""Pretraining goes on with what was found, never with the hidden gap; the comparison says what changed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.deployments.retrain import outcome, pretrain_config, retrain, table
from mpc_sgft.storage import run_folder

FOUND = {"actuator_gain": {"gain": 0.52}, "payload": {"mass": 0.4, "at": ["puck"]}}


def test_pretraining_gets_the_found_effects_and_not_the_gap(tmp_path: Path) -> None:
    run = compose.compose("deploy", ["task=push", "gap=dev_late", "seed=4"], ["gap=dev_late"])
    made = pretrain_config(run, tmp_path, 5000, effects=FOUND)
    assert made.gap.effects == FOUND and "dev_late" not in str(made)
    assert (made.transitions, made.random_transitions, made.seed) == (5000, 0, 4)
    assert Path(made.checkpoint).name == "push.safetensors" and made.task == run.task
    assert (made.imagined_steps, made.hold_value) == (run.planner.horizon, 1666)
    assert set(made.randomize.draws) == {"mass", "friction", "gain", "latency"}


def test_the_comparison_counts_rollouts_to_95_percent(tmp_path: Path) -> None:
    summary = {"zero_shot_success": 0.1, "final_success": 0.97, "real_rollouts": 10}
    (tmp_path / "summary.json").write_text(json.dumps(summary | {"curve": {"0": 0.1, "5": 0.95, "10": 0.97}}))
    after = outcome(tmp_path)
    assert after == summary | {"rollouts_to_95": 5}
    lines = table({"before": after | {"rollouts_to_95": None}, "after": after}).splitlines()
    assert lines[1].endswith("> 10") and lines[2].split("|")[1].strip() == "10%" and lines[2].endswith(" 5")
    on_a_robot = after | {"zero_shot_success": None}
    assert table({"before": on_a_robot, "after": on_a_robot}).splitlines()[1].split("|")[1].strip() == "-"


def test_the_latest_run_stays_the_one_that_was_diagnosed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both runs are real ones but for what they compute: they begin their folder, and so take over `latest`."""
    monkeypatch.chdir(tmp_path)
    summary = {"zero_shot_success": 0.1, "final_success": 0.2, "real_rollouts": 1, "curve": {"0": 0.1}}

    def run(cfg) -> int:
        folder = run_folder.start(cfg)
        (folder / "summary.json").write_text(json.dumps(summary | {"final_success": 0.9}))
        return 0

    monkeypatch.setattr("mpc_sgft.runs.pretrain.pretrain", run)
    monkeypatch.setattr("mpc_sgft.runs.deploy.deploy", run)
    first = run_folder.start(compose.compose("deploy", ["task=push"], []))
    (first / "summary.json").write_text(json.dumps(summary))
    found = retrain(Path("runs/push/latest"), Path("runs/push/latest/diagnosis"), 10, effects=FOUND)
    assert (found["before"]["final_success"], found["after"]["final_success"]) == (0.2, 0.9)
    assert json.loads((first / "diagnosis" / "retrain.json").read_text()) == found
    assert Path("runs/push/latest").resolve() == first / "diagnosis" / "deploy"
    cfg = OmegaConf.load(first / "diagnosis" / "deploy" / "config.yaml")
    assert Path(cfg.checkpoint) == first / "diagnosis" / "pretrain"


def test_an_unfinished_run_is_no_baseline(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not finished. Go on: python -m mpc_sgft.deploy --resume"):
        outcome(tmp_path)
