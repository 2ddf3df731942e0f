"""The figures of the paper from what was measured here, and each of its claims beside ours.

    python -m tools.studies.paper_figures results/paper

Writes success by real rollouts of every task and method (its Figure 4), by planning horizon (5), returns of the
sim-to-sim tasks (6), the simulator's value (7), and claims.csv: what the paper says, what is here, and whether that
confirms it. Takes seconds; what was not run is not drawn.

Source: Yin, Westenbroek et al., ICLR 2025.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from statistics import median

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from mpc_sgft.command.compose import compose
from mpc_sgft.runs import build
from mpc_sgft.views.deploy_view import values_on
from tools.studies.plot_study import Curves, panel, values
from tools.studies.runner import write
from tools.tables import RESULTS, percent
from tools.tables import read as rows_of

COLUMNS = ["figure", "paper", "here", "verdict"]
CONFIRMED, NOT, OPEN = "confirmed", "not confirmed", "not tested"
IN_THE_MEAN = "confirmed in the mean"  # over gaps, not in each
PUSH = ("turned", "sluggish", "skate")
TASKS = {
    "hammer_real": "hammer",
    "insert_real": "insert",
    "push_towel_real": "push_towel",
    "push_ball_real": "push_ball",
}
SIM_TO_SIM = {"walker_real": "walker_walk", "rope_real": "rope_peg_in_hole"}
BASELINES = ("tdmpc2", "sac", "iql", "pbrs", "rlpd")  # that the paper fine-tunes
VALUED = ("push", "hammer", "insert")
GRID = 61


def existing(*names: str) -> list[Path]:
    return [RESULTS / name for name in names if (RESULTS / name).exists()]


def files_of(tasks: dict[str, str]) -> list[str]:
    return [f"tasks/{task}{method}.csv" for task in tasks.values() for method in ("", "_tdmpc2")]


def of_tasks(tasks: dict[str, str], column: str = "success") -> Curves:
    return values(existing(*files_of(tasks)), column)


def on_robot_tasks() -> Curves:
    """Push's gaps, and the realities of the other tasks."""
    pushed = [f"transfer/{method}.csv" for method in ("sgft", "tdmpc2")]
    methods = [f"benchmark/{name}.csv" for name in ("curves", "hammer", "push_ball")]
    return values(existing(*pushed, *files_of(TASKS), *methods))


def of_horizons() -> Curves:
    """Each horizon's curve; H = 4, which all other runs have, is that of the transfer, as far as the others go."""
    found, usual = values(existing("horizon/horizon.csv")), values(existing("transfer/sgft.csv"))
    for gap, curves in found.items():
        if "sgft" in curves:
            curves["sgft horizon=4"] = curves.pop("sgft")
        last = max(max(curve) for curve in curves.values())
        if "sgft" in usual[gap]:
            curves["sgft horizon=4"] = {n: x for n, x in usual[gap]["sgft"].items() if n <= last}
    return found


def drawn(curves: Curves, gaps: list[str], ylabel: str, columns: int = 4) -> Figure:
    """A panel a gap, at most so many side by side, and one legend for all."""
    columns = min(columns, len(gaps))
    rows = -(-len(gaps) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4.2 * columns, 3.4 * rows + 0.4), squeeze=False)
    known = {}
    for axis, gap in zip(axes.flat, gaps, strict=False):
        seeds = sorted({len(values) for points in curves[gap].values() for values in points.values()})
        panel(axis, f"{gap}, seeds: {' to '.join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))}", curves[gap])
        axis.set_ylabel(ylabel)
        axis.get_legend().remove()
        known |= dict(zip(curves[gap], axis.get_lines(), strict=True))
    for axis in list(axes.flat)[len(gaps) :]:
        axis.set_axis_off()
    across = min(len(known), 2 * columns)
    lines = -(-len(known) // across)
    figure.tight_layout(rect=(0, 0, 1, 1 - (0.15 + 0.25 * lines) / figure.get_figheight()))
    figure.legend(list(known.values()), list(known), loc="upper center", ncols=across, frameon=False)
    return figure


def maps() -> Figure:
    """V of the shipped checkpoints over the plane that each task names."""
    figure, axes = plt.subplots(1, len(VALUED), figsize=(4.6 * len(VALUED), 3.6))
    for axis, task in zip(axes, VALUED, strict=True):
        cfg = compose("evaluate", [f"task={task}"], [])
        env, (agent, _) = build.make_env(cfg, 1), build.load_agent(cfg)
        plane = env.task.value_plane(GRID)
        assert plane is not None
        image = axis.imshow(
            values_on(plane, agent.model, env.history).T, origin="lower", extent=plane.extent, aspect="auto"
        )
        figure.colorbar(image, ax=axis, label="V")
        (x, x_unit), (y, y_unit) = plane.axes
        axis.set(title=task, xlabel=f"{x} [{x_unit}]", ylabel=f"{y} [{y_unit}]")
        for name, place in plane.marks.items():
            axis.plot(*place, "w+")
            axis.annotate(name, place, color="w", fontsize="small", xytext=(4, 4), textcoords="offset points")
    figure.tight_layout()
    return figure


# -- claims ------------------------------------------------------------------------------------------------------------


def middle(curves: Curves, gap: str, method: str = "sgft") -> dict[int, float]:
    """Median over the seeds by rollouts; empty if it was not run."""
    return {k: median(v) for k, v in sorted(curves.get(gap, {}).get(method, {}).items())}


def verdict(tested: bool, holds: bool) -> str:
    return (CONFIRMED if holds else NOT) if tested else OPEN


def reaches(gaps: tuple[str, ...], goal: float, within: int) -> Callable[[Curves], tuple[str, str]]:
    """Whether the median of SGFT's seeds ends at a success in every gap, within so many rollouts."""

    def judge(curves: Curves) -> tuple[str, str]:
        found = {gap: middle(curves, gap) for gap in gaps}
        if not all(found.values()):
            return "", OPEN
        last = {gap: (max(k for k in curve if k <= within), curve) for gap, curve in found.items()}
        said = ", ".join(f"{gap} {percent(curve[k])} after {k}" for gap, (k, curve) in last.items())
        return said, verdict(True, all(curve[k] >= goal for k, curve in last.values()))

    return judge


def poor(curves: Curves) -> tuple[str, str]:
    """Whether zero-shot transfer is at most one in two everywhere."""
    found = {gap: curve[0] for gap in (*PUSH, *TASKS) if (curve := middle(curves, gap))}
    said = ", ".join(f"{gap} {percent(share)}" for gap, share in found.items())
    return said, verdict(bool(found), all(share <= 0.5 for share in found.values()))


def falls_first(curves: Curves) -> tuple[str, str]:
    """Whether TD-MPC2's fine-tuning falls below zero-shot where zero-shot does something."""
    found = {gap: middle(curves, gap, "tdmpc2") for gap in (*PUSH, *TASKS)}
    asked = {gap: (curve[0], min(curve.values())) for gap, curve in found.items() if curve and curve[0] >= 0.2}
    said = ", ".join(f"{gap} {percent(start)} falls to {percent(least)}" for gap, (start, least) in asked.items())
    return said, verdict(bool(asked), all(least < start - 0.05 for start, least in asked.values()))


def faster(_: Curves) -> tuple[str, str]:
    """Whether a run of SGFT probably ends above one of each of the paper's baselines, pooled over the gaps."""
    if not existing("benchmark/better.csv"):
        return "", OPEN
    rows = [r for r in rows_of("benchmark/better.csv") if r["method"] == "sgft" and r["over"] in BASELINES]
    first = min(int(r["rollouts"]) for r in rows)
    by = {r["over"]: r for r in rows if int(r["rollouts"]) == first}
    found = [f"{m} {percent(r['probability'])} [{percent(r['low'])}, {percent(r['high'])}]" for m, r in by.items()]
    gaps = " and ".join(dict.fromkeys(r["gaps"] for r in by.values()))
    said = f"pooled over the gaps ({gaps}), a run of SGFT ends above one of the others after {first} rollouts with a "
    said += "probability of: "
    said += ", ".join(found)
    judged = verdict(len(by) == len(BASELINES), all(float(r["low"]) > 0.5 for r in by.values()))
    return said, IN_THE_MEAN if judged == CONFIRMED else judged


def horizon_matters(_: Curves) -> tuple[str, str]:
    """Whether horizons differ more in what they return at the end with the peg than with the walker, as shares."""
    path = existing("horizon/horizon.csv")
    if not {"rope_real", "walker_real"} <= set(values(path)):
        return "", OPEN
    found = values(path, "return")
    differ = {}
    for gap in ("rope_real", "walker_real"):
        ends = [median(curve[max(curve)]) for curve in found[gap].values()]
        differ[gap] = (max(ends) - min(ends)) / max(abs(end) for end in ends)
    said = ", ".join(f"{gap} by {percent(share)}" for gap, share in differ.items())
    return f"returns differ between horizons in {said}", verdict(True, differ["rope_real"] > 2 * differ["walker_real"])


def sim_to_sim(_: Curves) -> tuple[str, str]:
    """Whether returns rise in the sim-to-sim tasks."""
    found = {gap: middle(of_tasks(SIM_TO_SIM, "return"), gap) for gap in SIM_TO_SIM}
    said = ", ".join(f"{gap} return {c[0]:.0f} to {c[max(c)]:.0f} after {max(c)}" for gap, c in found.items() if c)
    rises = [c[max(c)] > c[0] + 0.1 * abs(c[0]) for c in found.values() if c]
    return said, verdict(len(rises) == len(found), all(rises))


def improvable(_: Curves) -> tuple[str, str]:
    if not existing("audit/auc.csv"):
        return "", OPEN
    (found,) = rows_of("audit/auc.csv")
    area = f"{percent(found['auc'])} [{percent(found['low'])}, {percent(found['high'])}]"
    said = f"the audited share tells runs that reach 90 % from others with an area under the curve of {area}"
    return said, verdict(True, float(found["low"]) > 0.5)


CLAIMS: list[tuple[str, str, Callable[[Curves], tuple[str, str]]]] = [
    ("4", "zero-shot transfer is poor in every task", poor),
    ("4", "pushing reaches 100 % within an hour (about 200 rollouts)", reaches(PUSH, 1.0, 200)),
    ("4", "hammering reaches 100 % within an hour (about 200 rollouts)", reaches(("hammer_real",), 1.0, 200)),
    ("4", "inserting reaches 70 % within two hours (about 400 rollouts)", reaches(("insert_real",), 0.7, 400)),
    ("4", "towel and ball are pushed as a puck", reaches(("push_towel_real", "push_ball_real"), 0.9, 200)),
    ("4", "baselines that are fine-tuned first get worse", falls_first),
    ("4", "SGFT is better than every baseline after as many rollouts", faster),
    ("5", "the horizon matters for the peg, hardly for the walker", horizon_matters),
    ("6", "SGFT raises the return in the sim-to-sim tasks", sim_to_sim),
    ("-", "where V is improvable, SGFT works (Definition 1)", improvable),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    curves, returns, horizons = (
        on_robot_tasks(),
        of_tasks(SIM_TO_SIM, "return"),
        of_horizons(),
    )
    pictures = {
        "4_success": (curves, [gap for gap in (*PUSH, *TASKS) if gap in curves], "success"),
        "5_horizon": (horizons, list(horizons), "success"),
        "6_sim_to_sim": (returns, list(returns), "return"),
    }
    figures = {name: drawn(*what) for name, what in pictures.items() if what[1]} | {"7_value": maps()}
    for name, figure in figures.items():
        figure.savefig(args.folder / f"{name}.png", dpi=100)
        plt.close(figure)
    rows = ((figure, paper, *judge(curves)) for figure, paper, judge in CLAIMS)
    write(args.folder / "claims.csv", COLUMNS, (dict(zip(COLUMNS, row, strict=True)) for row in rows))


if __name__ == "__main__":
    main()
