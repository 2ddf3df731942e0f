"""What a cheaper search costs: time, success, and how far its plans fall behind a search ten times as wide.

    python -m tools.studies.plan_quality results/plan_quality/plan_quality.csv --runs none=SHIPPED turned=runs/turned
        skate=runs/skate --variants "" planner.precision=bfloat16 planner.iterations=2

`--runs` names gaps and the run folder or checkpoint that plans there; SHIPPED is the checkpoint of the package. Regret
is the return of a plan of `--reference`, the configured search unless given, with ten times its candidates, less that
of the variant's, both valued in float32 on latents that the configured search visits; `ratio` is that of the times of
their plans, the reference as it is. A row that is in the CSV is not measured again.
"""

import argparse
import time
from pathlib import Path
from statistics import median

import torch
from omegaconf import DictConfig
from torch import Tensor

from mpc_sgft.api import configure, load_agent, make_env, make_planner
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs.build import prepare_process
from mpc_sgft.runs.collect import collect, planner_policy, score
from planners.base import h_step_return
from tools.studies.runner import measured

COLUMNS = [
    "gap",
    "variant",
    "episodes",
    "success",
    "success_low",
    "success_high",
    "return",
    "regret",
    "spread",
    "plan_ms",
    "ratio",
]
WIDER = 10
SEED = 3_000_000  # shared with no collected and no evaluated episode


def config(gap: str, run: str, variant: str) -> DictConfig:
    return configure(f"gap={gap}", *([] if run == "SHIPPED" else [f"checkpoint={run}"]), *variant.split())


def latents(cfg: DictConfig, model: WorldModel, count: int = 100) -> Tensor:
    """Some latents of episodes that the planner drives, [count, D]."""
    env = make_env(cfg, 16)
    data = collect(env, planner_policy(model, make_planner(cfg, model.action_dim), SEED), seed=SEED)
    pick = torch.randperm(data.numel(), generator=torch.Generator().manual_seed(SEED))[:count]
    with torch.inference_mode():
        return model.encode(data["observation"].flatten(0, 1)[pick])


@torch.inference_mode()
def regret(cfg: DictConfig, reference: DictConfig, model: WorldModel, z: Tensor) -> tuple[float, float]:
    """Mean return that the wide search finds beyond this one, and the returns' standard deviation, reward units."""
    wide = reference.copy()
    for name in ("num_candidates", "num_prior", "num_elites"):
        wide.planner[name] = WIDER * reference.planner[name]
    found = []
    for search in (wide, cfg):
        plan = make_planner(search, model.action_dim).plan(model, z, None, None, torch.Generator().manual_seed(SEED))
        found.append(h_step_return(model, z, plan.mean.unsqueeze(1), reference.task.discount).squeeze(1))
    return float((found[0] - found[1]).mean()), float(found[0].std())


def milliseconds(cfg: DictConfig, reference: DictConfig, model: WorldModel, z: Tensor) -> tuple[float, float]:
    """Median time of a plan from one latent, and its ratio to one of the reference, timed in turn."""
    planners = [make_planner(search, model.action_dim) for search in (cfg, reference)]
    generator, times = torch.Generator().manual_seed(0), ([], [])
    for row in z[:40].split(1):
        for planner, found in zip(planners, times, strict=True):
            start = time.perf_counter()
            planner.plan(model, row, None, None, generator)
            found.append(1e3 * (time.perf_counter() - start))
    own, other = (median(found[5:]) for found in times)
    return own, own / other


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--runs", nargs="+", required=True, metavar="gap=RUN")
    parser.add_argument("--variants", nargs="+", default=[""], metavar="'name=value ...'", help="'' as it is")
    parser.add_argument("--reference", default="", metavar="'name=value ...'", help="whose search, widened, is best")
    parser.add_argument("--episodes", type=int, default=200)
    args = parser.parse_args()
    runs = dict(text.split("=", 1) for text in args.runs)

    def work(gap: str, variant: str) -> dict[str, object]:
        cfg, plain = config(gap, runs[gap], variant), config(gap, runs[gap], "")
        prepare_process(cfg)
        model = load_agent(cfg).model
        z = latents(plain, model)
        reference = config(gap, runs[gap], args.reference)
        behind, spread = regret(cfg, reference, model, z)
        plan_ms, ratio = milliseconds(cfg, reference, model, z)
        env = make_env(cfg, args.episodes)
        result = score(
            collect(env, planner_policy(model, make_planner(cfg, model.action_dim), SEED + 1), seed=SEED + 1)
        )
        return {
            "gap": gap, "variant": variant, "episodes": result.episodes, "success": result.success,
            "success_low": round(result.success_low, 3), "success_high": round(result.success_high, 3),
            "return": round(result.episode_return, 2), "regret": round(behind, 3), "spread": round(spread, 2),
            "plan_ms": round(plan_ms, 1), "ratio": round(ratio, 2),
        }  # fmt: skip

    measured(args.csv, COLUMNS, [{"gap": gap, "variant": v} for v in args.variants for gap in runs], work)


if __name__ == "__main__":
    main()
