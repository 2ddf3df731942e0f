"""What more costs: a plan by candidates, horizon, environments and model; start-up times; bytes of a rollout.

    python -m tools.benchmarks.cost_growth [--parts plan start disk thousand] [--repeats 20] [--out CSV]

`plan`: one thread; each row changes one number of the first one, and `ratio` is to that one, measured beside it.
`start`: seconds until a command has said `--help`, until the libraries under every command are imported, and until a
deployment has recorded its first rollout; that once more without Python's compiled files, beside it.
`disk`: bytes that ten more rollouts of push add to run.rrd and to the episodes, a rollout.
`thousand`: what a run of a thousand rollouts of push takes; its search is a small one, which changes no size.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from mpc_sgft.runs.collect import planner_policy
from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import ROOT, SPACES, UPSTREAM, cpu_name
from tools.studies.runner import write

COLUMNS = ["part", "what", "value", "amount", "unit", "ratio", "cpu"]
BASE = {"num_candidates": 128, "horizon": 4, "environments": 1, "model": "small"}
COMMANDS = ("pretrain", "deploy", "evaluate", "diagnose")
LIBRARIES = ("torch", "tensordict", "torchrl.envs")  # each imports those before it
VARIED = {
    "num_candidates": [128, 256, 512, 1024, 2048],
    "horizon": [1, 2, 4, 8, 16],
    "environments": [1, 10, 100],
    "model": ["small", "1M", "5M"],
}


def plan_call(num_candidates: int, horizon: int, environments: int, model: str):
    """A plan of the default search, in float32 whatever the processor."""
    obs_dim, action_dim = SPACES.get(model, UPSTREAM)
    sizes = {"obs_dim": obs_dim, "action_dim": action_dim, "decode_dim": 4}
    world = instantiate(OmegaConf.load(ROOT / f"configs/model/{model}.yaml"), **sizes)
    search = OmegaConf.load(ROOT / "configs/planner/mppi.yaml")
    numbers = {"num_candidates": num_candidates, "horizon": horizon, "action_dim": action_dim, "precision": "float32"}
    act = planner_policy(world.eval(), instantiate(search, **numbers, discount=0.95), seed=0)
    observation, fresh = torch.randn(environments, obs_dim), torch.zeros(environments, dtype=torch.bool)
    return lambda: act(observation, fresh)


def plans(repeats: int) -> list[dict[str, object]]:
    """Median time of a plan by each number, and of the first one right beside it."""
    rows: list[dict[str, object]] = []
    base = plan_call(**BASE)  # type: ignore[arg-type]
    for name, values in VARIED.items():
        for value in values:
            call, times = plan_call(**(BASE | {name: value})), ([], [])  # type: ignore[arg-type]
            base(), call()
            for _ in range(repeats):
                for kept, run in zip(times, (base, call), strict=True):
                    start = time.perf_counter()
                    run()
                    kept.append(time.perf_counter() - start)
            first, this = map(median, times)
            rows.append(_row("plan", name, value, 1e3 * this, "ms", this / first))
    return rows


def starts(repeats: int) -> list[dict[str, object]]:
    """Seconds of `--help` of each command, of imports, and of a deployment until its first rollout is on disk."""
    rows = []
    lines = {f"{name} --help": ["-m", f"mpc_sgft.{name}", "--help"] for name in COMMANDS}
    lines |= {f"import {name}": ["-c", f"import {name}"] for name in LIBRARIES}
    for what, words in lines.items():
        took = []
        for _ in range(repeats):
            start = time.perf_counter()
            subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
            took.append(time.perf_counter() - start)
        rows.append(_row("start", what, "", median(took), "s"))
    compiled, not_compiled = [], []
    for _ in range(repeats):
        compiled.append(first_rollout())
        not_compiled.append(first_rollout(PYTHONPYCACHEPREFIX="nowhere", PYTHONDONTWRITEBYTECODE="1"))
    took = median(compiled)
    rows.append(_row("start", "deploy to the first rollout", "", took, "s"))
    rows.append(_row("start", "the same, nothing compiled", "", median(not_compiled), "s", median(not_compiled) / took))
    return rows


def first_rollout(**environment: str) -> float:
    """Seconds until a new deployment, with these environment variables, begins its first rollout."""
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "run" / "episodes" / "0001.mcap"
        words = ["rollouts=1", "quiet=true", f"run_dir={folder}/run"]
        line, start = [sys.executable, "-m", "mpc_sgft.deploy", *words], time.perf_counter()
        with subprocess.Popen(
            line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=os.environ | environment
        ) as process:
            while not first.exists() and process.poll() is None:
                time.sleep(0.02)
            took = time.perf_counter() - start
            if first.exists():  # the rest is not of interest
                process.kill()
            said = process.stderr.read() if process.stderr else b""
        if not first.exists():
            raise RuntimeError(f"deploy ended with {process.returncode}: {said.decode()[-500:]}")
    return took


def disk() -> list[dict[str, object]]:
    """Bytes that a rollout adds, from runs of 5 and of 15."""
    few, more = sizes(5), sizes(15)
    return [_row("disk", name, "a rollout", (more[name] - few[name]) / 10 / 1e3, "kB") for name in few]


def thousand() -> list[dict[str, object]]:
    """Bytes of a run of 1000 rollouts."""
    found = sizes(1000, "planner.num_candidates=64", "planner.num_elites=8", "planner.iterations=2")
    return [_row("disk", name, "1000 rollouts", size / 1e6, "MB") for name, size in found.items()]


def sizes(rollouts: int, *words: str) -> dict[str, int]:
    """Bytes of run.rrd and of the episodes of a run that learns nothing."""
    with tempfile.TemporaryDirectory() as folder:
        run, few = Path(folder) / "run", ["eval_every=1000", "eval_episodes=1", "quiet=true"]
        line = [sys.executable, "-m", "mpc_sgft.deploy", "method=zero_shot", f"rollouts={rollouts}", *few, *words]
        subprocess.run([*line, f"run_dir={run}"], check=True, stdout=subprocess.DEVNULL)
        episodes = sum(path.stat().st_size for path in (run / "episodes").iterdir())
        return {"run.rrd": (run / "run.rrd").stat().st_size, "episodes": episodes}


def _row(part: str, what: str, value: object, amount: float, unit: str, ratio: float | None = None) -> dict:
    row = {"part": part, "what": what, "value": value, "amount": round(amount, 2), "unit": unit}
    return row | {"ratio": None if ratio is None else round(ratio, 2), "cpu": cpu_name()}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"plan": lambda n: plans(n), "start": lambda n: starts(max(1, n // 6)), "disk": lambda n: disk()}
    parts |= {"thousand": lambda n: thousand()}
    parser.add_argument("--parts", nargs="+", default=[*parts], choices=[*parts])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=ROOT / "results/scale/cost_growth.csv")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    rows: list[dict[str, object]] = []
    for part in args.parts:
        for row in parts[part](args.repeats):
            rows.append(row)
            print(row, flush=True)
        write(args.out, COLUMNS, rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
