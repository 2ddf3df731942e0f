"""A method from elsewhere in the benchmark: stable-baselines3's SAC, first in the simulator, then on real rollouts.

    python -m tools.studies.enter_sb3 results/entry/sb3_sac.csv --gaps push-turned push-mild --rollouts 30

It needs `pip install 'mpc_sgft[sb3]'`. Each row is an evaluation after so many real rollouts; rows are added.
"""

import argparse
import csv
from pathlib import Path

import gymnasium
import numpy as np
import torch

from mpc_sgft import benchmark

COLUMNS = ["name", "method", "seed", "sim_steps", "rollouts", "success", "return", "episodes"]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument(
        "--gaps", nargs="+", required=True, help="TASK-GAP of the same task; one simulator serves them all"
    )
    parser.add_argument("--sim-steps", type=int, default=60_000, help="control steps in the simulator")
    parser.add_argument("--rollouts", type=int, default=30, help="real rollouts")
    parser.add_argument("--eval-every", type=int, default=10, help="real rollouts between evaluations")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    try:
        from stable_baselines3 import SAC
    except ImportError:
        parser.error("stable-baselines3 is not installed: pip install 'mpc_sgft[sb3]'")
    torch.set_num_threads(1)
    task = args.gaps[0].split("-")[0]
    sim = gymnasium.make(f"mpc_sgft/{task}-sim-v0")
    numbers = {"gamma": 0.95, "learning_starts": 1000, "seed": args.seed, "verbose": 0, "device": "cpu"}
    pretrained = args.csv.with_suffix(".zip")
    SAC("MlpPolicy", sim, **numbers).learn(args.sim_steps, progress_bar=False).save(pretrained)
    for gap in args.gaps:
        name = f"mpc_sgft/{gap}-v0"
        env = gymnasium.make(name, rollouts=args.rollouts, seed=args.seed)
        model = SAC.load(pretrained, env=env, device="cpu", learning_starts=0)
        _write(args, name, model, 0)
        while (spent := env.unwrapped.spent) < args.rollouts:  # type: ignore[attr-defined]
            steps = env.unwrapped.env.task.episode_steps * args.eval_every  # type: ignore[attr-defined]
            model.learn(steps, reset_num_timesteps=False)
            assert env.unwrapped.spent > spent  # type: ignore[attr-defined]
            _write(args, name, model, env.unwrapped.spent)  # type: ignore[attr-defined]
    pretrained.unlink()


def _write(args: argparse.Namespace, name: str, model, rollouts: int) -> None:
    def act(observation: np.ndarray) -> np.ndarray:
        return model.predict(observation, deterministic=True)[0]

    result = benchmark.evaluate(name, act)
    words = [name, "sb3 SAC", args.seed, args.sim_steps, rollouts]
    row = dict(zip(COLUMNS, [*words, result.success, round(result.episode_return, 3), result.episodes], strict=True))
    print(row, flush=True)
    new = not args.csv.exists()
    with args.csv.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    main()
