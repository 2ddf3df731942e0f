"""ControlEnv.step at N = 64 beside raw MuJoCo on two threads: the same scene, states, commands and physics steps.

    python -m tools.benchmarks.benchmark_env [--tasks push hammer ...] [--repeats 7]

For each task, as it is pretrained: one episode of random actions in 64 environments is run through `ControlEnv.step`,
and its commands and first states are kept. Then, in turn and in this one process:

    control_env   the episode again through `ControlEnv.step` (commands are ramps; the reset is not counted)
    raw_mj_step   two Python threads, 32 environments each, one `mj_step(model, data, nstep)` a control step with the
                  command held at its new value: the least that these physics steps can cost

Machines are noisy, so the repetitions are interleaved and the ratio is the median of the ratios of neighbours.
"""

import argparse
import csv
import os
import platform
import sys
import threading
import time
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numpy as np
import torch
from hydra import compose, initialize_config_module
from hydra.utils import instantiate

from envs.backends.sim import SimBackend
from envs.env import ControlEnv
from mpc_sgft.storage.run_folder import cpu_name

ROOT = Path(__file__).resolve().parents[2]
N, THREADS, BAR = 64, 2, 0.8
TASKS = "push push_towel push_ball hammer insert rope_peg_in_hole walker_walk cheetah_run pendulum".split()
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def episode(env: ControlEnv, actions: torch.Tensor) -> float:
    """Seconds that the steps of one episode take; always the same episode."""
    env.set_seed(0)
    state = env.reset()
    began = time.perf_counter()
    for action in actions:
        state["action"] = action
        state = env.step(state)["next"]
    return time.perf_counter() - began


def commands(env: ControlEnv, actions: torch.Tensor) -> tuple[np.ndarray, list[np.ndarray]]:
    """The episode's first states [N, state] and its ramps of commands, each [N, S, nu]."""
    env.set_seed(0)
    state = env.reset()
    first, ramps = env.backend.batch.state.copy(), []
    backend = env.backend
    advance = backend._advance
    backend._advance = lambda ctrl: (ramps.append(ctrl), advance(ctrl))[1]  # type: ignore[method-assign]
    for action in actions:
        state["action"] = action
        state = env.step(state)["next"]
    del backend._advance
    return first, ramps


def raw(model: mujoco.MjModel, first: np.ndarray, ramps: list[np.ndarray]) -> float:
    """Seconds for the same physics steps in plain `mj_step`, on two Python threads."""

    def work(sims: range) -> None:
        data = mujoco.MjData(model)
        for i in sims:
            mujoco.mj_setState(model, data, first[i], STATE)
            for ramp in ramps:
                data.ctrl = ramp[i, -1]
                mujoco.mj_step(model, data, nstep=ramp.shape[1])

    threads = [threading.Thread(target=work, args=(range(k, N, THREADS),)) for k in range(THREADS)]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return time.perf_counter() - began


def measure(name: str, repeats: int) -> list[dict[str, Any]]:
    """Rows of one task, ControlEnv first."""
    with initialize_config_module("configs", version_base="1.3"):
        task = compose("pretrain", [f"task={name}"]).task
    backend = SimBackend(instantiate(task.env, _convert_="all"), N, threads=THREADS)
    env = ControlEnv(backend, history=task.history)
    actions = 2 * torch.rand(env.task.episode_steps, N, env.action_dim, generator=torch.Generator().manual_seed(0)) - 1
    first, ramps = commands(env, actions)
    steps = N * sum(ramp.shape[1] for ramp in ramps)
    ways = {"control_env": lambda: episode(env, actions), "raw_mj_step": lambda: raw(backend.model, first, ramps)}
    times: dict[str, list[float]] = {}
    for _ in range(repeats + 1):
        for what, run in ways.items():
            times.setdefault(what, []).append(run())
    times = {what: values[1:] for what, values in times.items()}  # the first round warms up
    env_seconds = times["control_env"]
    rows = []
    for what, values in times.items():
        ratio = median(v / e for v, e in zip(values, env_seconds, strict=True))
        rows.append(
            {
                "task": name,
                "what": what,
                "physics_steps_per_s": round(steps / median(values)),
                "control_steps_per_s": round(N * len(ramps) / median(values)),
                "seconds_median": round(median(values), 4),
                "seconds_min": round(min(values), 4),
                "control_env_over_this": round(ratio, 3),
                "num_envs": N,
                "threads": THREADS,
                "repeats": repeats,
                "cpu": cpu_name(),
                "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
                "load": round(os.getloadavg()[0], 2),
                "mujoco": mujoco.__version__,
                "python": platform.python_version(),
            }
        )
        told = rows[-1]["physics_steps_per_s"]
        print(f"{name:12s} {what:12s} {told:8d} physics steps/s   ControlEnv at {ratio:.2f} of it", flush=True)
    return rows


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=TASKS, help=f"default: {' '.join(TASKS)}")
    parser.add_argument("--repeats", type=int, default=7, help="rounds (default 7)")
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/benchmark_env.csv", help="CSV to write")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    rows = [row for name in args.tasks for row in measure(name, args.repeats)]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with open(args.out, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    worst = min(rows, key=lambda row: row["control_env_over_this"])
    print(f"worst ratio {worst['control_env_over_this']:.2f} ({worst['task']}), bar {BAR}; written to {args.out}")
    return int(worst["control_env_over_this"] < BAR)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
