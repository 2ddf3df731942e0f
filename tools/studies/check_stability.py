"""Random episodes of a task with all its randomisation: how often does the physics fail?

    python -m tools.studies.check_stability [--task push] [--episodes 10000] [--seed 0] [--out JSON]

Half of the environments draw every action anew, the others hold one for several steps: a held command drives the arm to
the edges of its workspace, a new one shakes it. Ends with exit code 1 if any episode was unstable.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_module

from envs.env import ControlEnv
from mpc_sgft.runs.build import make_env

N = 64
HELD = 10  # control steps


def batch(env: ControlEnv, seed: int) -> tuple[int, float, float]:
    """One episode in each environment: how many were unstable, the largest |observation| and joint or puck speed."""
    env.set_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    state, before = env.reset(), env.backend.counters["unstable"]
    far = fast = 0.0
    for k in range(env.task.episode_steps):
        fresh = 2 * torch.rand(N, env.action_dim, generator=generator) - 1
        if k % HELD == 0:
            held = fresh.sign()
        state["action"] = torch.cat([fresh[: N // 2], held[N // 2 :]])
        state = env.step(state)["next"]
        fine = ~state["invalid"][:, 0]
        if fine.any():
            far = max(far, float(state["observation"][fine].abs().max()))
            fast = max(fast, float(abs(env.backend.qvel[fine.numpy()]).max()))
    return env.backend.counters["unstable"] - before, far, fast


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="push", help="configs/task/<name>.yaml")
    parser.add_argument("--episodes", type=int, default=10_000, help="how many (default 10000)")
    parser.add_argument("--seconds", type=float, default=0, help="stop after so long; 0: never")
    parser.add_argument("--seed", type=int, default=0, help="of the first batch")
    parser.add_argument("--out", type=Path, help="also write the result here, as JSON")
    args = parser.parse_args(argv)
    with initialize_config_module("configs", version_base="1.3"):
        cfg = compose("pretrain", [f"task={args.task}", f"randomize={args.task}"])
    env = make_env(cfg, N, randomised=True)
    began, episodes, unstable, far, fast = time.monotonic(), 0, 0, 0.0, 0.0
    while episodes < args.episodes and not (args.seconds and time.monotonic() - began > args.seconds):
        failed, b, c = batch(env, args.seed + episodes // N)
        episodes, unstable, far, fast = episodes + N, unstable + failed, max(far, b), max(fast, c)
    took = time.monotonic() - began
    print(f"{args.task}: {episodes} random episodes, {episodes * env.task.episode_steps} control steps in {took:.0f} s")
    print(f"unstable: {unstable}; largest |observation| {far:.3g}, largest speed {fast:.3g} rad/s or m/s")
    if args.out:
        steps = episodes * env.task.episode_steps
        found = {"unstable": unstable, "largest_observation": far, "largest_speed": fast, "seconds": round(took, 1)}
        result = {"task": args.task, "seed": args.seed, "episodes": episodes, "control_steps": steps} | found
        args.out.write_text(json.dumps(result, indent=2) + "\n")
    return int(unstable > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
