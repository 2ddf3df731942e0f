"""How long a plan and an update take, beside the matrix-multiply peak of the same cores and upstream TD-MPC2's figures.

    python -m tools.benchmarks.time_planner [--quick] [--sizes small 1M 5M] [--threads 1 2] [--out CSV]

Everything is measured in this process. `share` is the arithmetic of all matrix products, divided by the best time and
by the fp32 peak beside it, measured before and after the row. `cpu_ms` is processor time: on one thread it is what a
quiet machine would take, and where it is far below the median the machine was busy. Two threads on busy cores wait for
each other, and say nothing then. `decay` divides the candidates after each iteration. Upstream's figures were measured
once, on cores of 95 GFLOP/s.
"""

import argparse
import csv
import itertools
import os
import platform
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch.utils.flop_counter import FlopCounterMode

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs.collect import planner_policy
from planners.base import PRECISIONS
from planners.malloc import keep_freed_memory
from planners.mppi import MPPI

ROOT = Path(__file__).resolve().parents[2]
SPACES = {"small": (22, 2)}  # entries of observation and action: push with its history; others as upstream was measured
UPSTREAM = (12, 3)
DECAYS = (1.0, 1.25)  # of the candidates: upstream's search, and one that narrows
SEARCH = {"num_candidates": 512, "num_prior": 24, "num_elites": 64, "iterations": 6}  # upstream's, for every size
BATCH = 256  # slices of an update
UPSTREAM_PEAK = {1: 95.0, 2: 190.0}  # GFLOP/s in fp32 of the cores on which upstream was measured, by threads
UPSTREAM_MS = {  # eager fp32 on a quiet AMD EPYC with AVX-512-BF16, (what, size, horizon, threads)
    ("plan", "1M", 4, 1): 375, ("plan", "5M", 4, 1): 959, ("plan", "1M", 4, 2): 200,
    ("update", "1M", 3, 1): 224, ("update", "5M", 3, 1): 788, ("update", "5M", 3, 2): 450,
}  # fmt: skip


def known_sizes() -> list[str]:
    """Model sizes that stand for themselves."""
    return sorted(p.stem for p in (ROOT / "configs/model").glob("*.yaml") if "_target_" in OmegaConf.load(p))


def seconds(call: Callable[[], object], repeats: int) -> tuple[list[float], list[float]]:
    """Wall and processor time [s] of each of `repeats` calls, after one that is not counted."""
    call()
    wall, cpu = [], []
    for _ in range(repeats):
        start = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - start[0])
        cpu.append(time.process_time() - start[1])
    return wall, cpu


def peak_gflops(repeats: int) -> float:
    """Best fp32 rate of a matrix product that fits the caches, GFLOP/s."""
    a, b = torch.randn(2048, 512), torch.randn(512, 2048)
    return 2 * 2048 * 512 * 2048 / min(seconds(lambda: a @ b, repeats)[0]) / 1e9


def random_batch(obs_dim: int, action_dim: int, steps: int) -> TensorDict:
    """Slices with the keys of the replay buffer, [BATCH, steps]."""
    shape = (BATCH, steps)
    following = {
        "observation": torch.randn(*shape, obs_dim),
        "reward": torch.rand(*shape, 1),
        "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
    }
    now = {"observation": torch.randn(*shape, obs_dim), "action": torch.rand(*shape, action_dim) * 2 - 1}
    return TensorDict({**now, "next": TensorDict(following, shape)}, shape)


def flop(call: Callable[[], object]) -> int:
    """Multiplications and additions in the matrix products of one call."""
    with FlopCounterMode(display=False) as counted:
        call()
    return int(counted.get_total_flops())


def agent_of(size: str, precision: str) -> Agent:
    """A new agent with a model of this size; every update of it has every part, as upstream's."""
    obs_dim, action_dim = SPACES.get(size, UPSTREAM)
    sizes = {"obs_dim": obs_dim, "action_dim": action_dim, "decode_dim": min(obs_dim, 12)}
    model: WorldModel = instantiate(OmegaConf.load(ROOT / f"configs/model/{size}.yaml"), **sizes)
    train = OmegaConf.load(ROOT / "configs/train/default.yaml")
    return instantiate(train.agent, model=model, discount=0.99, precision=precision, policy_delay=1)


def jobs(size: str, precision: str, many: bool) -> list[tuple[str, int, float, int, Callable[[], object]]]:
    """(what, horizon, decay, rows, call) of all that is timed for a model; `many` plans 100 environments too."""
    agent, (obs_dim, action_dim) = agent_of(size, precision), SPACES.get(size, UPSTREAM)
    model = agent.model
    out: list[tuple[str, int, float, int, Callable[[], object]]] = []
    for horizon in (3, 4):
        for decay in DECAYS if horizon == 4 else (1.0,):
            numbers = {"action_dim": action_dim, "horizon": horizon, "precision": precision, "candidate_decay": decay}
            planner = MPPI(**numbers, **SEARCH)
            for envs in (1, 100) if many and size == "small" and horizon == 4 else (1,):
                act, fresh = planner_policy(model, planner, seed=0), torch.ones(envs, dtype=torch.bool)
                act = partial(act, torch.randn(envs, obs_dim), fresh)
                out.append(("plan", horizon, decay, envs, act))
        batch = random_batch(obs_dim, action_dim, horizon)
        out.append(("update", horizon, 1.0, BATCH, lambda b=batch: agent.update(b)))
    return out


def cpu_name() -> str:
    """Name of the processor as the operating system gives it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def measure(
    sizes: list[str], threads: list[int], precisions: list[str], repeats: int, malloc: str
) -> list[dict[str, object]]:
    """One row for each size, thread count and job, printed as it comes."""
    machine = {"cpu": cpu_name(), "cores": os.cpu_count(), "torch": torch.__version__, "malloc": malloc}
    print(f"{machine['cpu']}, {machine['cores']} cores, torch {machine['torch']}, malloc {malloc}")
    heads = "what size H precision decay rows threads median_ms best_ms cpu_ms peak share upstream ratio".split()
    print("".join(f"{head:>10}" for head in heads))
    rows = []
    for count in threads:
        torch.set_num_threads(count)
        for size, precision in itertools.product(sizes, precisions):
            for what, horizon, decay, batch, call in jobs(size, precision, many=repeats > 3):
                work, before = flop(call), peak_gflops(repeats)
                wall, cpu = seconds(call, repeats if batch != 100 else max(2, repeats // 5))
                peak = max(before, peak_gflops(repeats))
                theirs = UPSTREAM_MS.get((what, size, horizon, count))
                row: dict[str, object] = {"what": what, "size": size, "horizon": horizon, "precision": precision}
                row |= {"decay": decay if what == "plan" else "", "rows": batch, "threads": count}
                row |= {"median_ms": round(median(wall) * 1e3, 1), "best_ms": round(min(wall) * 1e3, 1)}
                row |= {"cpu_ms": round(median(cpu) * 1e3, 1), "peak_gflops": round(peak, 1)}
                row |= {"share_of_peak": round(work / min(wall) / 1e9 / peak, 3), "upstream_ms": theirs}
                row |= {"ratio_to_upstream": round(median(wall) * 1e3 / theirs, 2) if theirs else None}
                print("".join(f"{'' if x is None else x:>10}" for x in row.values()), flush=True)
                theirs_peak = UPSTREAM_PEAK[count] if theirs else None
                row |= {"gflop": round(work / 1e9, 3), "upstream_peak_gflops": theirs_peak, "repeats": len(wall)}
                rows.append(row | machine)
    return rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="3 repeats instead of 20, one environment")
    parser.add_argument("--sizes", nargs="+", default=["small", "1M", "5M"], choices=known_sizes())
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], choices=(1, 2))
    parser.add_argument("--precisions", nargs="+", default=["float32", "bfloat16"], choices=PRECISIONS)
    parser.add_argument("--default-malloc", action="store_true", help="without planners.malloc.keep_freed_memory()")
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/time_planner.csv")
    args = parser.parse_args(arguments)
    malloc = "default" if args.default_malloc or not keep_freed_memory() else "kept"
    rows = measure(args.sizes, args.threads, args.precisions, 3 if args.quick else 20, malloc)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
