"""What a GPU brings: plans, updates, environment steps, pretraining push end to end, and its fine-tuning.

    python -m tools.benchmarks.gpu_bench [--sizes 1M 5M 48M] [--envs 4096] [--pretrain DIR] [--deploy DIR] [--out CSV]

Each row is measured after calls that are not counted, with the device waited for before the clock is read. Plans and
updates are measured as recorded CUDA graphs and as single launches. An update is one of twenty of which the last is
read, as in pretraining. Fine-tuning is also measured on the processor of the same machine. `--device cpu` runs the same
on the processor: to see that it works, or to compare.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from mpc_sgft.command import compose
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import collect, planner_policy, random_policy
from planners.mppi import MPPI
from tools.benchmarks.time_planner import ROOT, SEARCH, UPSTREAM, cpu_name, random_batch
from tools.studies.runner import write

COLUMNS = [
    "what",
    "size",
    "precision",
    "recorded",
    "count",
    "median_ms",
    "per_second",
    "success",
    "parts_s",
    "device",
    "torch",
]
UPDATES = 20  # of which the last is read
SETTLED = 4  # calls that are not counted: the first ones compile, and record


def seconds(call: Callable[[], object], repeats: int, device: torch.device, settled: int = SETTLED) -> float:
    """Median time [s] of a call that the device has finished."""
    found = []
    for _ in range(repeats + settled):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        found.append(time.perf_counter() - start)
    return median(found[settled:])


def networks(size: str, precision: str, recorded: bool, device: torch.device, repeats: int) -> list[dict[str, object]]:
    """One plan (H = 4, upstream's search) and one update (256 slices of 3 steps)."""
    obs_dim, action_dim = UPSTREAM
    sizes = {"obs_dim": obs_dim, "action_dim": action_dim, "decode_dim": obs_dim}
    model: WorldModel = instantiate(OmegaConf.load(ROOT / f"configs/model/{size}.yaml"), **sizes)
    numbers = OmegaConf.load(ROOT / "configs/train/default.yaml").agent
    how = {"precision": precision, "cuda_graph": recorded}
    agent: Agent = instantiate(numbers, model=model, discount=0.99, device=device, policy_delay=1, **how)
    planner = MPPI(action_dim=action_dim, horizon=4, **how, **SEARCH)
    act, batch = planner_policy(agent.model, planner, seed=0), random_batch(obs_dim, action_dim, 3).to(device)
    observation, fresh = torch.randn(1, obs_dim), torch.zeros(1, dtype=torch.bool)

    def updates() -> None:
        for left in reversed(range(UPDATES)):
            agent.update(batch, read=left == 0)

    plan = seconds(lambda: act(observation, fresh), repeats, device)
    update = seconds(updates, max(1, repeats // 5), device) / UPDATES
    row = {"size": size, "precision": precision, "recorded": recorded, "count": 1}
    return [
        {"what": what, **row, "median_ms": round(1e3 * found, 3)}
        for what, found in (("plan", plan), ("update", update))
    ]


def environments(count: int, physics: str, repeats: int, device: torch.device) -> dict[str, object]:
    """Control steps a second of push, randomised, under random actions; resets are counted in."""
    cfg = compose.compose("pretrain", ["task=push", f"physics={physics}"], [])
    env = build.make_env(cfg, count, randomised=True, learning=True)
    act, steps = random_policy(env, 0), env.task.episode_steps * count
    found = seconds(lambda: collect(env, act, seed=0), repeats, device, settled=1)  # which compiles
    row = {"what": "environment steps", "size": physics, "precision": "float32" if physics == "warp" else "float64"}
    return row | {"count": count, "median_ms": round(1e3 * found, 1), "per_second": round(steps / found)}


def pretraining(device: str, folder: Path, settings: list[str]) -> dict[str, object]:
    """Push from scratch on the device."""
    done = command("pretrain", device, folder, settings)
    return whole("pretrain push", done) | {"count": done["transitions"], "success": done["success"]}


def finetuning(device: str, folder: Path, settings: list[str]) -> dict[str, object]:
    """SGFT of the shipped checkpoint in `turned` on the device, for twenty rollouts."""
    words = ["gap=turned", "rollouts=20", "eval_every=20", "eval_episodes=50"]
    done = command("deploy", device, folder, [*words, *settings])
    return whole("fine-tune push", done) | {"count": done["real_rollouts"], "success": done["final_success"]}


def command(name: str, device: str, folder: Path, settings: list[str]) -> dict[str, Any]:
    """Summary of a command's run of push into a new folder."""
    words = ["task=push", f"device={device}", f"run_dir={folder}", "quiet=true", *settings]
    subprocess.run([sys.executable, "-m", f"mpc_sgft.{name}", *words], check=True)
    return json.loads((folder / "summary.json").read_text())


def whole(what: str, done: dict[str, Any]) -> dict[str, object]:
    """A run's row, but for what it counts."""
    parts = ", ".join(f"{part} {spent}" for part, spent in done["seconds"].items())
    row = {"what": what, "size": "small", "precision": "auto", "median_ms": round(1e3 * done["wall_seconds"])}
    return row | {"parts_s": parts}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--sizes", nargs="*", default=["1M", "5M", "48M"])
    parser.add_argument("--envs", type=int, default=4096, help="environments side by side; 0 leaves them out")
    parser.add_argument("--physics", nargs="+", default=["warp", "mujoco"], choices=["warp", "mujoco"])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--pretrain", type=Path, metavar="DIR", help="also pretrain push, into this new folder")
    parser.add_argument("--deploy", type=Path, metavar="DIR", help="also fine-tune push, into new folders in this one")
    parser.add_argument("--settings", nargs="*", default=[], help="of these runs, beside the default ones")
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/gpu_bench.csv")
    args = parser.parse_args(arguments)
    device = torch.device(args.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.exit(2, "error: PyTorch finds no CUDA device here; --device cpu runs the same on the processor.\n")
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()
    rows: list[dict[str, object]] = []

    def keep(found: dict[str, object]) -> None:
        rows.append({"device": name, "torch": torch.__version__} | found)
        print(rows[-1], flush=True)
        write(args.out, COLUMNS, rows)

    for size in args.sizes:
        for precision, recorded in product(
            ("float32", "bfloat16"), (True, False) if device.type == "cuda" else (False,)
        ):
            for found in networks(size, precision, recorded, device, args.repeats):
                keep(found)
    for physics in args.physics if args.envs else []:
        found = environments(args.envs, physics, max(1, args.repeats // 10), device)
        keep(found | ({} if physics == "warp" else {"device": cpu_name()}))
    if args.pretrain is not None:
        keep(pretraining(device.type, args.pretrain, args.settings))
    if args.deploy is not None:
        for kind in dict.fromkeys((device.type, "cpu")):
            found = finetuning(kind, args.deploy / kind, args.settings)
            keep(found | {"device": name if kind == device.type else cpu_name()})
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
