"""Close the loop: go on pretraining in the repaired simulator, or in ranges found, deploy again, and compare.

The gap of the run is handed to the second deployment alone, as a robot would be: diagnosis and retraining know only
what was found.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.deployments.recordings import run_config

TARGET = 0.95  # success that counts as solved
HELD = 3  # share of retraining, one in so many, that leaves encoder and V alone
HEAD = "              |  zero-shot |    final | rollouts to 95 %"


def retrain(
    run: Path,
    out: Path,
    transitions: int,
    *,
    effects: Mapping[str, Mapping[str, Any]] | None = None,
    randomize: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Pretrain from the run's own start with what was found, deploy again; returns the comparison.

    Args:
        run: Folder of the finished first deployment.
        out: Folder for `pretrain/`, `deploy/` and retrain.json.
        transitions: Of pretraining in the repaired simulator.
        effects: {effect: parameters} that diagnose found; None: none.
        randomize: As in configs/randomize/*.yaml, found; None: the task's own.

    Raises:
        UserError: If the run was not finished, or a folder of an earlier retraining is in the way.
    """
    from mpc_sgft.runs.deploy import deploy
    from mpc_sgft.runs.pretrain import pretrain

    run, out = run.resolve(), out.resolve()  # runs/latest is another run as soon as pretraining begins
    cfg, before = run_config(run), outcome(run)
    made = pretrain_config(cfg, out / "pretrain", transitions, effects=effects, randomize=randomize)
    _finish(pretrain(made), "pretraining")
    again = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
    assert isinstance(again, DictConfig)
    again.checkpoint, again.run_dir, again.resume = str(out / "pretrain"), str(out / "deploy"), None
    _finish(deploy(again), "the second deployment")
    result = {"transitions": transitions, "before": before, "after": outcome(out / "deploy")}
    (out / "retrain.json").write_text(json.dumps(result, indent=2) + "\n")
    return result


def pretrain_config(
    cfg: DictConfig,
    folder: Path,
    transitions: int,
    *,
    effects: Mapping[str, Any] | None = None,
    randomize: Mapping[str, Any] | None = None,
) -> DictConfig:
    """The config of pretraining in the repaired simulator, from the config of a deployment.

    Args:
        cfg: Of the deployment; its gap is not used.
        folder: Run folder to write.
        transitions: How long.
        effects, randomize: As in `retrain`.
    """
    from mpc_sgft.command import compose
    from mpc_sgft.runs import build

    task = str(cfg.chosen.task)
    made = compose.compose("pretrain", [f"task={task}"], [])
    with open_dict(made):
        made.task, made.planner, made.seed, made.device = cfg.task, cfg.planner, cfg.seed, cfg.device
        made.checkpoint = cfg.checkpoint if cfg.checkpoint is not None else str(build.shipped(build.agents_of(cfg)))
        made.gap.effects = dict(effects or {})
        made.chosen.gap = "+".join(["none", *(effects or {})])
        if randomize is not None:
            made.randomize = dict(randomize)
        made.run_dir, made.quiet = str(folder), cfg.quiet
        made.transitions = made.min_transitions = transitions
        made.eval_episodes = made.final_episodes = cfg.eval_episodes
        made.random_transitions = 0  # the policy prior collects from the first round on
        made.lr_halves_every = max(1, transitions // 2)
        made.imagined_steps, made.hold_value = int(cfg.planner.horizon), transitions // HELD
    OmegaConf.resolve(made)
    return made


def outcome(run: Path) -> dict[str, Any]:
    """Zero-shot and final success of a finished deployment, and real rollouts until 95 % (null if never).

    Raises:
        UserError: If it has no summary yet.
    """
    path = run / "summary.json"
    if not path.is_file():
        raise UserError(
            f"{run}: no summary.json, the deployment was not finished. Go on: python -m mpc_sgft.deploy --resume {run}"
        )
    summary = json.loads(path.read_text())
    reached = [int(k) for k, success in summary["curve"].items() if success >= TARGET]
    return {
        "zero_shot_success": summary["zero_shot_success"],
        "final_success": summary["final_success"],
        "real_rollouts": summary["real_rollouts"],
        "rollouts_to_95": min(reached) if reached else None,
    }


def table(result: Mapping[str, Any]) -> str:
    """The comparison for the terminal."""
    lines = [HEAD]
    for name, row in (("before repair", result["before"]), ("after repair", result["after"])):
        count = row["rollouts_to_95"]
        more = f"> {row['real_rollouts']}" if count is None else str(count)
        zero_shot = "-" if row["zero_shot_success"] is None else f"{row['zero_shot_success']:.0%}"  # as on a robot
        lines.append(f"{name:13} | {zero_shot:>10} | {row['final_success']:8.0%} | {more:>16}")
    return "\n".join(lines)


def _finish(code: int, what: str) -> None:
    if code:
        raise UserError(f"{what} ended with exit code {code}; see the messages above.")
