"""Pretraining goes on with what was found, never with the hidden gap; the comparison says what changed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.deployments.retrain import outcome, pretrain_config, table

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


def test_an_unfinished_run_is_no_baseline(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not finished. Go on: python -m mpc_sgft.deploy --resume"):
        outcome(tmp_path)
