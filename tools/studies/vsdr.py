"""Which of some pretrained checkpoints to put on the machine, from simulation and from recordings of any one (VSDR).

    python -m tools.studies.vsdr ranking.csv --run runs/push/latest --checkpoints runs/a runs/b runs/c
    python -m tools.studies.vsdr ranking.csv --run runs/push/latest --checkpoints runs/a runs/b runs/c --gap turned

A checkpoint is good if it succeeds in the randomised simulator, and if the machine's observations look to it like those
of the simulator: `distance` is the mean Mahalanobis distance of recorded latents from those of half of its simulated
episodes, over that of the other half, so that 1 is no further than simulation itself.

    score = z(success in simulation) - z(log distance),   z over the checkpoints

No checkpoint is driven for it; the recordings may be of another one. With `--gap` each is also measured in that gap,
and how well the ranking foretells that is printed (Spearman's correlation), beside either half of it alone.

What differs from the publication: latents of the world model's encoder are looked at, where there it is a network for
images. One distance, and the same weight of both halves, are our choice.

Source: Leibovich et al., "Validate on Sim, Detect on Real: Model Selection for Domain Randomization", ICRA 2022,
arXiv:2111.00765.
"""

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import torch
from scipy.stats import spearmanr
from tensordict import TensorDict
from torch import Tensor

from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.deployments.recordings import run_config
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import Score, collect, planner_policy, score
from mpc_sgft.runs.pretrain import EVAL_SEED
from mpc_sgft.storage.episode_file import read_episode
from mpc_sgft.storage.rollout import from_episode
from tools.studies.runner import write

COLUMNS = [
    "rank",
    "checkpoint",
    "score",
    "sim_success",
    "sim_return",
    "distance",
    "gap_success",
    "episodes",
    "recorded",
]
RIDGE = 1e-3  # of the mean variance, added to each: latents lie in a simplex


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument(
        "--run", type=Path, required=True, help="run folder of a deployment, whose episodes are the data"
    )
    parser.add_argument("--checkpoints", nargs="+", required=True, help="run folders of pretraining, or files")
    parser.add_argument("--episodes", type=int, default=100, help="simulated, of each checkpoint")
    parser.add_argument("--gap", help="measure each in this gap, too")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    if len(args.checkpoints) < 2:
        parser.error("--checkpoints: a ranking takes two or more.")
    if args.episodes < 2:
        parser.error(f"--episodes {args.episodes}: two or more, half of them are the yardstick.")
    try:
        task, real = recorded(args.run)
        rows = [row(path, task, real, args.gap, args.episodes, args.seed) for path in args.checkpoints]
    except (UserError, ValueError) as error:
        parser.exit(2, f"error: {error}\n")
    rank(rows)
    write(args.csv, COLUMNS, rows)
    for r in rows:
        gap = "" if args.gap is None else f", {args.gap} {r['gap_success']:.0%}"
        print(f"{r['rank']}. {r['checkpoint']}: simulation {r['sim_success']:.0%}, distance {r['distance']:.2f}{gap}")
    if args.gap is not None:
        found = {name: foretells(rows, name) for name in ("score", "sim_success", "distance")}
        print(f"foretells {args.gap}: " + ", ".join(f"{name} {value:.2f}" for name, value in found.items()))
    return 0


def recorded(run: Path) -> tuple[str, Tensor]:
    """Task of a deployment, and all observations it recorded [N, O].

    Raises:
        UserError: If the folder is not that of a deployment, or holds no episode.
        ValueError: For a file that is no episode.
    """
    task = str(run_config(run).chosen.task)
    episodes = [read_episode(path) for path in sorted((run / "episodes").glob("*.mcap"))]
    seen = [from_episode(e, n).steps["observation"] for n, e in enumerate(episodes, 1) if e.transitions]
    if not seen:
        raise UserError(f"--run {run}: no episodes in {run / 'episodes'}. Deploy at least one rollout first.")
    return task, torch.cat(seen)


def row(path: str, task: str, real: Tensor, gap: str | None, episodes: int, seed: int) -> dict[str, object]:
    """What is known of one checkpoint, but for its place among the others."""
    model, result, steps = driven([f"task={task}", f"checkpoint={path}"], episodes, seed, randomised=True)
    half = episodes // 2
    near, far = (latents(model, steps[part]["observation"].flatten(0, 1)) for part in (slice(half), slice(half, None)))
    distance = mahalanobis(near, latents(model, real)).mean() / mahalanobis(near, far).mean()
    known: dict[str, object] = {"checkpoint": path, "sim_success": result.success, "sim_return": result.episode_return}
    known |= {"distance": float(distance), "episodes": episodes, "recorded": len(real)}
    if gap is not None:
        words = [f"task={task}", f"checkpoint={path}", f"gap={gap}"]
        known["gap_success"] = driven(words, episodes, seed, randomised=False)[1].success
    return known


def driven(words: list[str], episodes: int, seed: int, *, randomised: bool) -> tuple[WorldModel, Score, TensorDict]:
    """A checkpoint, and its episodes in the simulator [N, T]."""
    cfg = compose("evaluate", [*words, f"seed={seed}", f"episodes={episodes}"], [])
    model = build.load_agent(cfg)[0].model
    env = build.make_env(cfg, episodes, randomised=randomised)
    with closing(env.backend):
        build.check_fits(model, env)
        act = planner_policy(model, build.make_planner(cfg, env.action_dim), seed)
        steps = collect(env, act, seed=EVAL_SEED + seed)
    return model, score(steps), steps


@torch.no_grad()
def latents(model: WorldModel, observation: Tensor) -> Tensor:
    """Of observations [N, O], double precision."""
    return model.encode(observation.to(next(model.parameters()).device)).double().cpu()


def mahalanobis(reference: Tensor, points: Tensor) -> Tensor:
    """Distances of points [N, D] from the mean of a reference [M, D], in its standard deviations, [N]."""
    cov = torch.cov(reference.T)
    cov += RIDGE * cov.diagonal().mean() * torch.eye(len(cov), dtype=cov.dtype)
    off = points - reference.mean(0)
    return (off * torch.linalg.solve(cov, off.T).T).sum(1).sqrt()


def rank(rows: list[dict]) -> None:
    """Give rows their score and place, the best first."""
    success = torch.tensor([r["sim_success"] for r in rows], dtype=torch.float64)
    distance = torch.tensor([r["distance"] for r in rows], dtype=torch.float64).log()
    for r, value in zip(rows, (_z(success) - _z(distance)).tolist(), strict=True):
        r["score"] = value
    rows.sort(key=lambda r: -r["score"])
    for place, r in enumerate(rows, 1):
        r["rank"] = place


def _z(values: Tensor) -> Tensor:
    spread = values.std()
    return (values - values.mean()) / spread if spread > 0 else torch.zeros_like(values)


def foretells(rows: list[dict], column: str) -> float:
    """Spearman's correlation of a column with success in the gap; of the distance, of how small it is."""
    sign = -1 if column == "distance" else 1
    return sign * float(spearmanr([r[column] for r in rows], [r["gap_success"] for r in rows]).statistic)


if __name__ == "__main__":
    raise SystemExit(main())
