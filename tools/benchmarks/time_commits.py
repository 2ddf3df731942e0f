"""A plan and an update as another commit makes them, beside those of this one: results/timing/time_commits.csv.

    python -m tools.benchmarks.time_commits COMMIT [--what plan update] [--sizes small 1M] [--precisions auto float32]

Each commit has a checkout and a process of its own, with one thread; they are timed in turn. The plan is the configured
one (configs/planner/mppi.yaml), the update that of pretraining (configs/train/default.yaml) on 256 slices of three
steps, `adapt` an update of a deployment with all its maps (configs/method/sgft.yaml) on as many of four, the weights
are random ones. A commit that knows no `precision` computes in float32. `ratio` is this commit's
best time to the other's.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import torch

from tools.benchmarks.time_planner import ROOT, SPACES, UPSTREAM, cpu_name, known_sizes
from tools.studies.runner import write

COLUMNS = "what size precision before after before_ms after_ms ratio rounds cpu torch".split()
ROUNDS = 15
WORK = ["plan", "update", "adapt"]
CHILD = """  # runs in either checkout, and so asks for what both have
import json, sys, time
own = [f for f in sys.meta_path if not getattr(f, "__module__", "").startswith("__editable__")]
sys.meta_path[:] = own  # an editable install would fill in what a checkout lacks
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from mpc_sgft.runs.collect import planner_policy
from planners.malloc import keep_freed_memory
from tools.benchmarks.time_planner import random_batch
whats, size, precision, obs_dim, action_dim = *sys.argv[1:4], *map(int, sys.argv[4:])
def configured(path):
    cfg = OmegaConf.load(path)
    for part in (cfg, cfg.get("agent", {})):
        if "precision" in part:
            part.precision = precision
    return cfg
keep_freed_memory()
torch.set_num_threads(1)
torch.manual_seed(0)
sizes = {"obs_dim": obs_dim, "action_dim": action_dim, "decode_dim": min(obs_dim, 12)}
def agent_of(**more):
    model = instantiate(OmegaConf.load(f"configs/model/{size}.yaml"), **sizes, **more)
    return instantiate(configured("configs/train/default.yaml").agent, model=model, discount=0.99)
agent = agent_of()
planner = instantiate(configured("configs/planner/mppi.yaml"), action_dim=action_dim, discount=0.99)
act = planner_policy(agent.model, planner, seed=0)
seen, fresh = torch.randn(1, obs_dim), torch.ones(1, dtype=torch.bool)
batch, times = random_batch(obs_dim, action_dim, 3), 5
calls = {"plan": lambda: act(seen, fresh), "update": lambda: agent.update(batch)}
if "adapt" in whats.split(","):
    from mpc_sgft.learning.observation_map import Sensed
    numbers = OmegaConf.load("configs/method/sgft.yaml")
    numbers.horizon = 4
    method, starts = instantiate(numbers), torch.randn(8, obs_dim)
    sizes["decode_dim"] = min(obs_dim - 2 * action_dim, 12)
    names = ("tip_x", "tip_y", *(f"sensor_{i}" for i in range(2, sizes["decode_dim"])))
    deployed = agent_of(memory_dim=2 * action_dim)
    method.take_over(deployed, Sensed(names, starts[:, : len(names)]))
    slices = random_batch(obs_dim, action_dim, 4)
    calls["adapt"] = lambda: method.update(deployed, slices, starts=starts)
for line in sys.stdin:
    call, found = calls[line.strip()], []
    for _ in range(times):
        start = time.perf_counter()
        call()
        found.append(time.perf_counter() - start)
    print(json.dumps(1e3 * min(found)), flush=True)
"""


def short(commit: str) -> str:
    """Name of a commit, seven digits.

    Raises:
        SystemExit: If there is none.
    """
    line = ["git", "-C", str(ROOT), "rev-parse", "--short=7", "--verify", f"{commit}^{{commit}}"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{commit}: no commit of this repository. Give one that git log shows.")
    return done.stdout.strip()


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """A folder with that commit's files, for as long as it takes."""
    with tempfile.TemporaryDirectory() as folder:
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", f"{folder}/tree", commit], check=True)
        try:
            yield Path(folder) / "tree"
        finally:
            subprocess.run([*git, "remove", "--force", f"{folder}/tree"], check=True)


@contextmanager
def worker(tree: Path, whats: list[str], size: str, precision: str) -> Iterator[subprocess.Popen[str]]:
    """A process that times what its standard input names, with the code of a checkout."""
    spaces = [str(n) for n in SPACES.get(size, UPSTREAM)]
    own = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-c", CHILD, ",".join(whats), size, precision, *spaces]
    with subprocess.Popen(line, cwd=tree, env=own, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process
        assert process.stdin
        process.stdin.close()


def milliseconds(process: subprocess.Popen[str], what: str) -> float:
    """Best time of a few calls in a worker.

    Raises:
        SystemExit: If it ended.
    """
    assert process.stdin and process.stdout
    try:
        print(what, file=process.stdin, flush=True)
    except BrokenPipeError:  # it ended: nothing can be read below
        pass
    line = process.stdout.readline()
    if not line:
        sys.exit("The code of one commit ended before it was timed, for the reason above. Give a later one.")
    return float(json.loads(line))


def measure(
    trees: list[Path], size: str, precision: str, whats: list[str], names: list[str], rounds: int
) -> list[dict[str, object]]:
    """A row for each work with a model size."""
    rows: list[dict[str, object]] = []
    with ExitStack() as stack:
        workers = [stack.enter_context(worker(tree, whats, size, precision)) for tree in trees]
        for what in whats:
            found = [[milliseconds(process, what) for process in workers] for _ in range(rounds + 1)][1:]
            before, after = (min(column) for column in zip(*found, strict=True))
            row: dict[str, object] = {
                "what": what,
                "size": size,
                "precision": precision,
                "before": names[0],
                "after": names[1],
            }
            row |= {"before_ms": round(before, 2), "after_ms": round(after, 2), "ratio": round(after / before, 3)}
            rows.append(row | {"rounds": rounds, "cpu": cpu_name(), "torch": torch.__version__})
    return rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="as git names it")
    parser.add_argument("--what", nargs="+", default=WORK[:2], choices=WORK)
    parser.add_argument("--sizes", nargs="+", default=["small", "1M"], choices=known_sizes())
    parser.add_argument("--precisions", nargs="+", default=["auto", "float32"])
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of five calls each")
    parser.add_argument("--out", type=Path, default=ROOT / "results/timing/time_commits.csv")
    args = parser.parse_args(arguments)
    names = [short(args.commit), short("HEAD")]
    with ExitStack() as stack:
        trees = [stack.enter_context(checkout(name)) for name in names]
        pairs = itertools.product(args.sizes, args.precisions)
        rows = [row for pair in pairs for row in measure(trees, *pair, args.what, names, args.rounds)]
    write(args.out, COLUMNS, rows)
    print(f"written to {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
