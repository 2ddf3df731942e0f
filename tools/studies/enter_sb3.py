"""A method from elsewhere in the benchmark: stable-baselines3's SAC, first in the simulator, then on real rollouts.

    python -m tools.studies.enter_sb3 results/entry/sb3_sac.csv --gaps push-turned push-mild --rollouts 30

It needs `pip install 'mpc_sgft[sb3]'`. Each row is an evaluation after so many real rollouts.
"""

import argparse
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import torch

from mpc_sgft import benchmark
from tools.studies.runner import write

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
    names = [f"mpc_sgft/{gap}-v0" for gap in args.gaps]
    real = {name: gymnasium.make(name, rollouts=args.rollouts, seed=args.seed) for name in names}
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    pretrained = args.csv.with_suffix(".zip")
    sim = gymnasium.make(f"mpc_sgft/{args.gaps[0].split('-')[0]}-sim-v0")
    numbers = {"gamma": 0.95, "learning_starts": 1000, "seed": args.seed, "device": "cpu"}
    SAC("MlpPolicy", sim, **numbers).learn(args.sim_steps).save(pretrained)
    rows = []
    for name, env in real.items():
        model, reality = SAC.load(pretrained, env=env, device="cpu", learning_starts=0), env.unwrapped
        assert isinstance(reality, benchmark.RealRollouts)
        while True:
            act = partial(model.predict, deterministic=True)
            result = benchmark.evaluate(name, lambda observation, act=act: np.asarray(act(observation)[0]))
            done = [name, "sb3 SAC", args.seed, args.sim_steps, reality.spent]
            scored = [result.success, round(result.episode_return, 3), result.episodes]
            rows.append(dict(zip(COLUMNS, [*done, *scored], strict=True)))
            print(rows[-1], flush=True)
            write(args.csv, COLUMNS, rows)
            left = args.rollouts - reality.spent
            if not left:
                break
            model.learn(min(args.eval_every, left) * reality.env.task.episode_steps, reset_num_timesteps=False)
    pretrained.unlink()


if __name__ == "__main__":
    main()
