"""What the maps of commands and observations cost an update and a plan of a deployment: results/timing/time_maps.csv.

    python -m tools.benchmarks.time_maps [--task push] [--out CSV]

The shipped checkpoint, `method=sgft` and the planner as configured, one thread; updates are on episodes that the
pretrained policy explored. Each way has the maps of the one before and one more, all are timed in turn, and `to_none`
is the ratio of their best times to that without maps.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from mpc_sgft.command.compose import compose
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import planner_policy
from mpc_sgft.runs.explore import explored
from mpc_sgft.runs.fine_tuning import make_transfer
from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import ROOT, cpu_name, seconds
from tools.studies.runner import write

COLUMNS = "task maps what ms to_none cpu torch".split()
EPISODES, REPEATS, CALLS = 8, 20, 5
WAYS = {  # what leaves the later ones out
    "none": ["method.command_map=false", "method.observation_map=false"],
    "command": ["method.command_band=false", "method.observation_map=false"],
    "and one with a dead band": ["method.observation_map=false"],
    "and what sensors are suspected of": [],
}


def calls(task: str, settings: list[str]) -> dict[str, Callable[[], object]]:
    """An update and a plan of a deployment with these settings."""
    cfg = compose("deploy", [f"task={task}", "gap=none", "device=cpu", "quiet=true", *settings], [])
    build.prepare_process(cfg)
    agent, _ = build.load_agent(cfg)
    steps = explored(cfg, agent.model, EPISODES)
    transfer = make_transfer(cfg, agent, build.sensed(cfg), steps.shape[1])
    for episode in steps:
        transfer.buffer.extend(episode)
    starts = steps["observation"][:, 0]
    act = planner_policy(transfer.acting, build.make_planner(cfg, agent.model.action_dim), seed=0)
    return {
        "update": lambda: transfer.method.update(agent, transfer.batch(), starts=starts),
        "plan": lambda: act(starts[:1], torch.ones(1, dtype=torch.bool)),
    }


def measure(task: str, repeats: int) -> list[dict[str, object]]:
    """A row for each way and work."""
    ways = {name: calls(task, settings) for name, settings in WAYS.items()}
    best = {(name, what): float("inf") for name in ways for what in ways[name]}
    for _ in range(repeats):
        for name, what in best:
            best[name, what] = min(best[name, what], *seconds(ways[name][what], CALLS)[0])
    return [
        {"task": task, "maps": name, "what": what, "ms": round(1e3 * time, 2), "to_none": round(time / none, 2)}
        | {"cpu": cpu_name(), "torch": torch.__version__}
        for (name, what), time in best.items()
        if (none := best["none", what])
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="push", help="with a shipped checkpoint")
    parser.add_argument("--repeats", type=int, default=REPEATS, help=f"rounds of {CALLS} calls each")
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/time_maps.csv")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    write(args.out, COLUMNS, measure(args.task, args.repeats))
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
