"""What other settings would have learned from the rollouts of a deployment, without driving them again.

    python -m tools.studies.relearn relearn.csv runs/push/latest --at 20 30 --set method.entropy_coef=0.01

The recorded rollouts are learned from one after the other, as `deploy` does, and the agent is evaluated in the run's
gap after each number of them in --at. What a setting would have done to the rollouts themselves does not show: confirm
with a deployment. Rows are added to the CSV.
"""

import argparse
import csv
import sys
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.transfer import Transfer
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import collect, planner_policy, score
from mpc_sgft.runs.fine_tuning import make_transfer
from mpc_sgft.runs.pretrain import evaluation_seed
from mpc_sgft.storage.episode_file import read_episode
from mpc_sgft.storage.metrics import progress
from mpc_sgft.storage.rollout import Rollout, from_episode

COLUMNS = ["run", "gap", "settings", "seed", "rollouts", "success", "episodes"]


def config_of(run: Path, settings: list[str], seed: int) -> DictConfig:
    """The config of a finished run with some values changed.

    What is changed would have driven otherwise, so that wins of the recorded rollouts are none of its own: all are
    learned from then, whatever `method.win_stay` was, unless that is given.

    Raises:
        UserError: If the folder is no simulated deployment's, or a setting is unknown.
    """
    path = run / "config.yaml"
    if not path.is_file():
        raise UserError(f"{run} holds no config.yaml. Give the run folder of a deployment.")
    cfg = OmegaConf.load(path)
    assert isinstance(cfg, DictConfig)
    if "method" not in cfg:
        raise UserError(f"{run} is no deployment: its config.yaml has no `method`.")
    OmegaConf.set_struct(cfg, True)
    first = ["method.win_stay=0"] if settings and "win_stay" in cfg.method else []
    try:
        cfg.merge_with_dotlist([*first, *settings, f"seed={seed}"])
    except OmegaConfBaseException as err:
        raise UserError(f"--set {' '.join(settings)}: {err.args[0].splitlines()[0]}") from err
    if cfg.backend.name != "sim":
        raise UserError(
            f"{run} was driven with --backend {cfg.backend.name}: only a simulated gap can be evaluated in."
        )
    return cfg


def rollouts_of(run: Path) -> list[Rollout]:
    """The recorded rollouts of a run, in their order."""
    files = sorted((run / "episodes").glob("[0-9][0-9][0-9][0-9].mcap"))
    return [from_episode(read_episode(file), number) for number, file in enumerate(files, 1)]


def relearn(cfg: DictConfig, rollouts: list[Rollout], at: list[int]) -> tuple[Transfer, dict[int, float]]:
    """Learn from rollouts in their order; returns what was learned, and the success after each number in `at`."""
    build.prepare_process(cfg)
    agent, _ = build.load_agent(cfg)
    judge = build.make_env(cfg, cfg.eval_episodes)
    planner = build.make_planner(cfg, judge.action_dim)
    transfer = make_transfer(cfg, agent, build.sensed(cfg), judge.task.episode_steps)
    success = {}
    bar = progress(len(rollouts), initial=0, desc="relearn", unit="rollout", disable=False)
    for count, rollout in enumerate(rollouts, 1):
        lesson = rollout.lesson(transfer.slice_len)
        if lesson is None:
            transfer.interrupt()
        else:
            transfer.learn(lesson, success=rollout.success, warm_up=count <= cfg.warmup)
        bar.update(1)
        if count in at:
            seed = evaluation_seed(cfg)
            result = score(collect(judge, planner_policy(transfer.acting, planner, seed), seed=seed))
            success[count] = result.success
    bar.close()
    return transfer, success


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("run", type=Path, help="run folder of a deployment with --backend sim")
    parser.add_argument("--at", type=int, nargs="+", default=[30], help="evaluate after so many rollouts (default 30)")
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="settings to change")
    parser.add_argument("--seed", type=int, default=100, help="of the training (default 100)")
    args = parser.parse_args()
    try:
        cfg, rollouts = config_of(args.run, args.set, args.seed), rollouts_of(args.run)
        if max(args.at) > len(rollouts) or min(args.at) < 1:
            raise UserError(
                f"{args.run} has {len(rollouts)} rollouts; --at {' '.join(map(str, args.at))} asks for others."
            )
        _, success = relearn(cfg, rollouts[: max(args.at)], args.at)
    except UserError as err:
        sys.exit(f"error: {err}")
    gap = cfg.chosen.gap
    rows = [[args.run.name, gap, " ".join(args.set), args.seed, k, s, cfg.eval_episodes] for k, s in success.items()]
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    fresh = not args.csv.exists()
    with args.csv.open("a", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows] if fresh else rows)


if __name__ == "__main__":
    main()
