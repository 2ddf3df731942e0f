"""Does the critic know what it costs to push the puck too far? V at the start against what the planner then collects.

    python -m tools.studies.critic_profile results/critic_profile/critic_profile.csv [--checkpoints name=FILE ...]

For puck starts along x, in the nominal simulator: V(z_0), mean over episodes, and the mean discounted return of the
planner from there, where the last reward is taken to go on for ever. SGFT lives on the frozen V, and a gap may bring
the puck to where no episode of the simulator ever ended: there V must be right too.
"""

import argparse
import csv
from pathlib import Path

import torch

from mpc_sgft.command import compose
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import collect, planner_policy
from mpc_sgft.runs.pretrain import EVAL_SEED

PUCK_X = [0.1, 0.3, 0.5, 0.55, 0.6, 0.65]  # [m]; the line is at 0.55


def lasting_return(reward: torch.Tensor, discount: float) -> torch.Tensor:
    """Discounted return [N] of rewards [N, T], the last of which goes on for ever."""
    weight = discount ** torch.arange(reward.shape[1])
    weight[-1] /= 1 - discount
    return (weight * reward).sum(1)


def row(name: str, checkpoint: str | None, x: float, episodes: int) -> list:
    """One line of the CSV."""
    overrides = ["task=push", "gap=none", f"task.env.puck_x=[{x},{x}]"]
    cfg = compose.compose("evaluate", [*overrides, *([f"checkpoint={checkpoint}"] if checkpoint else [])], [])
    build.prepare_process(cfg)
    model = build.load_agent(cfg)[0].model.eval()
    env = build.make_env(cfg, episodes)
    planner = build.make_planner(cfg, env.action_dim)
    data = collect(env, planner_policy(model, planner, EVAL_SEED), seed=EVAL_SEED)
    with torch.inference_mode():
        value = model.terminal_value(model.encode(data["observation"][:, 0])).mean()
    found = lasting_return(data["next", "reward"][..., 0], cfg.task.discount).mean()
    return [name, x, episodes, round(float(value), 2), round(float(found), 2)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--checkpoints", nargs="+", default=["shipped="], metavar="name=FILE", help="'' is the shipped")
    parser.add_argument("--episodes", type=int, default=16)
    args = parser.parse_args()
    pairs = [text.partition("=")[::2] for text in args.checkpoints]
    rows = [row(name, file or None, x, args.episodes) for name, file in pairs for x in PUCK_X]
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    with args.csv.open("w", newline="") as file:
        csv.writer(file).writerows([["critic", "puck_x_m", "episodes", "value", "return"], *rows])


if __name__ == "__main__":
    main()
