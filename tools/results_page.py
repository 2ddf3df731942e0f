"""Tables of results/, for the documentation and the README; none is typed by hand.

    python -m tools.results_page --readme          # rewrite the headline table of README.md

`docs/results.md` is filled when the site is built (tools/docs_hooks.py).
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from statistics import median

from tools.ladder_table import ladder
from tools.tables import RESULTS, ROOT, Row, curves, digits, minutes, percent, pick, read, spread, table, tenth

TASKS = ("hammer", "insert", "push_towel", "push_ball", "rope_peg_in_hole")
BEGIN, END = "<!-- headline:begin -->", "<!-- headline:end -->"


ROUNDED = ("episodes", "success", "low", "high")


def pretrain() -> str:
    head = {
        "seed": "seed",
        "episodes": "episodes_evaluated",
        "success": ("success", tenth),
        "low": ("success_low", tenth),
    }
    head |= {"high": ("success_high", tenth), "prior": ("prior_success", percent), "minutes": ("wall_seconds", minutes)}
    parts = [
        f"{name}\n\n{pick(read(f'pretrain/{file}.csv'), head)}"
        for name, file in (("From scratch:", "pretrain"), ("The second stage (`+experiment=polish`):", "polish"))
    ]
    rounded = {"model": "model", "updates in": "precision"} | {k: v for k, v in head.items() if k in ROUNDED}
    return "\n\n".join([*parts, "A wide model:", pick(read("pretrain/precision.csv"), rounded | {"return": "return"})])


NAMED = {"gap": "gap", "seed": "seed", "effect": "effect", "parameter": "parameter"}
NAMED |= {name: (name, digits) for name in ("value", "low", "high")}


def transfer() -> str:
    rows = read("transfer/sgft.csv") + read("transfer/tdmpc2.csv")
    return curves(rows, method_in_gap, "gap and method")


def tasks() -> str:
    head: dict[str, str | tuple[str, Callable[[str], str]]] = {
        "task": "task",
        "transitions": "transitions",
        "minutes": "minutes",
        "planner's success": ("success", percent),
        "return": "return",
        "episodes": "episodes",
    }
    files = [f"tasks/{name}{method}.csv" for name in TASKS for method in ("", "_tdmpc2")]
    rows = [row for file in files if (RESULTS / file).exists() for row in read(file)]
    parts = [pick(read("tasks/pretrained.csv"), head), curves(rows, method_in_gap, "gap and method")]
    kept = [{**row, "task": name} for name in ("hammer", "insert") for row in read(f"tasks/{name}_mild.csv")]
    parts.append(f"In `mild`, where there is nothing to gain:\n\n{curves(kept, lambda row: row['task'], 'task')}")
    walked: dict[str, str | tuple[str, Callable[[str], str]]]
    walked = {"gap": "gap", "method": "method", "seed": "seed", "rollouts": "rollouts"}
    walked |= {"return": ("return", digits), "success": ("success", percent)}
    parts.append(f"Return, of at most 200:\n\n{pick(read('tasks/walker_walk.csv'), walked)}")
    bound = {name: name for name in ("checkpoint", "transitions", "episodes")} | {"return": ("return", digits)}
    parts.append(f"What training in `walker_real` itself comes to:\n\n{pick(read('tasks/walker_bound.csv'), bound)}")
    named = pick(read("tasks/diagnose_run.csv"), {**NAMED, "verdict": "verdict"})
    parts.append(f"What `diagnose --run` names in these realities:\n\n{named}")
    return "\n\n".join(parts)


def benchmark() -> str:
    """Who is how good after so many rollouts, in each gap and in all, and who is probably better than whom."""
    rows = read("benchmark/scores.csv")
    gaps = list(dict.fromkeys(row["gap"] for row in rows))
    parts = []
    for count in dict.fromkeys(row["rollouts"] for row in rows):
        mine = {(r["method"], r["gap"]): r for r in rows if r["rollouts"] == count}
        lines = [
            [f"`{m}`", *(mean_of(mine[m, g]) if (m, g) in mine else "" for g in gaps)]
            for m in dict.fromkeys(method for method, _ in mine)
        ]
        heads = [gap if gap == "all" else f"`{gap}`" for gap in gaps]
        parts.append(f"After {count} rollouts:\n\n{table(['method', *heads], lines)}")
    better = [row for row in read("benchmark/better.csv") if row["method"] == "sgft"]
    counts = list(dict.fromkeys(row["rollouts"] for row in better))
    by = {(row["over"], row["rollouts"]): row for row in better}
    lines = [
        [f"`{other}`", *(probable(by[other, n]) if (other, n) in by else "" for n in counts)]
        for other in dict.fromkeys(row["over"] for row in better)
    ]
    heads = [f"after {n} rollouts" for n in counts]
    parts.append(f"How probable it is that a run of `sgft` ends above one of\n\n{table(['', *heads], lines)}")
    runs = [row for row in read("benchmark/runs.csv") if row["seconds"] and row["updates"]]
    cost = []
    for method in dict.fromkeys(row["method"] for row in runs):
        own = [row for row in runs if row["method"] == method]
        seconds, updates = (median(float(row[name]) for row in own) for name in ("seconds", "updates"))
        cost.append([f"`{method}`", own[0]["rollouts"], f"{updates:.0f}", f"{seconds:.0f}"])
    head = ["method", "real rollouts", "updates", "seconds, median"]
    return "\n\n".join([*parts, "What a run costs:", table(head, cost)])


def mean_of(row: Row) -> str:
    return f"{percent(row['iqm'])} [{percent(row['low'])}, {percent(row['high'])}], {row['runs']}"


def probable(row: Row) -> str:
    return f"{percent(row['probability'])} [{percent(row['low'])}, {percent(row['high'])}]"


def method_in_gap(row: Row) -> str:
    return f"`{row['gap']}`, {row['method']}"


def audit() -> str:
    (found,) = read("audit/auc.csv")
    area = f"{percent(found['auc'])} [{percent(found['low'])}, {percent(found['high'])}]"
    runs = pick(
        read("audit/runs.csv"),
        {"gap": "gap", "seed": "seed", "improvable": ("share", percent), "best success": ("best", percent)},
    )
    head = ["area under the curve", "runs", "of gaps", "reached 90 %"]
    return table(head, [[area, found["runs"], found["gaps"], found["reached"]]]) + "\n\n" + runs


def blind() -> str:
    rows = [r for r in read("blind/blind.csv") if r["method"] == "diagnose"]
    lines = [[r["score"], r["goal"], f"{percent(r['value'])} [{percent(r['low'])}, {percent(r['high'])}]", r["of"]]
             for r in rows]  # fmt: skip
    others = [r for r in read("blind/blind.csv") if r["score"] in ("single, clear: top 1", "no effect: false alarms")]
    by = {
        m: [percent(r["value"]) for r in others if r["method"] == m] for m in dict.fromkeys(r["method"] for r in others)
    }
    simple = table(["method", "clear single effects: top 1", "false alarms"], [[m, *cells] for m, cells in by.items()])
    return table(["asked", "goal", "measured", "cases"], lines) + "\n\nBeside simpler ways:\n\n" + simple


def foreign() -> str:
    parts = []
    for file in ("foreign", "earlier"):
        rows = read(f"foreign/{file}.csv")
        parts.append(f"Seed {rows[0]['seed']}:\n\n{by_ground(rows)}")
    return "\n\n".join(parts)


def by_ground(rows: list[Row]) -> str:
    """Scores by ground."""
    grounds = list(dict.fromkeys(r["ground"] for r in rows))
    by = {(r["ground"], r["score"]): r for r in rows}
    lines = []
    for score in dict.fromkeys(r["score"] for r in rows):
        cells = [scored(by[g, score]) if (g, score) in by else "" for g in grounds]
        lines.append([score, next(r["goal"] for r in rows if r["score"] == score), *cells])
    return table(["asked", "goal", *(f"`{g}`" for g in grounds)], lines)


def scored(row: Row) -> str:
    """A share or a number of seconds, its interval, and of how many."""
    write = digits if "seconds" in row["score"] else percent
    return f"{write(row['value'])} [{write(row['low'])}, {write(row['high'])}] of {row['of']}"


def judgement() -> str:
    rows = read("judgement/judgement.csv")
    lines = []
    for name in dict.fromkeys(r["without"] for r in rows if "+" not in r["without"]):  # those are of fewer cases
        mine = [r for r in rows if r["without"] == name]
        right = sum(float(r[f"{g}_exact"] or 0) * int(r[f"{g}_exact_of"]) for r in mine for g in ("single", "pair"))
        wrong = sum(float(r[g] or 0) * int(r[f"{g}_of"]) for r in mine for g in ("false_alarms", "wrong_outside"))
        inside = sum(float(r["coverage"] or 0) * int(r["coverage_of"]) for r in mine)
        of = sum(int(r["coverage_of"]) for r in mine)
        changed = sum(int(r["changed"]) for r in mine)
        lines.append([f"`{name}`", changed, f"{right:.0f}", f"{wrong:.0f}", f"{inside:.0f} of {of}"])
    head = ("without", "answers that change", "exact sets", "wrong names", "intervals that cover")
    return table(head, lines)


def loop() -> str:
    head = {
        "gap": "gap",
        "seed": "seed",
        "zero-shot": ("zero_shot_before", percent),
        "after": ("zero_shot_after", percent),
    }
    head |= {"30 rollouts": ("final_before", percent), "after ": ("final_after", percent)}
    head |= {"rollouts to 95 %": "rollouts_to_95_before", "after  ": "rollouts_to_95_after"}
    parts = [pick(read("close_the_loop/close_the_loop.csv"), head)]
    alone = {"gap": "gap", "seed": "seed", "found": "found"} | {k: head[k] for k in ("zero-shot", "after")}
    identified = pick(read("close_the_loop/identify.csv"), alone)
    parts.append(f"Identification alone, from ten rollouts of the policy that fails:\n\n{identified}")
    for file, says in (
        ("diagnose_run", "What was named"),
        ("diagnose_run_again", "Of others, with the present solver"),
    ):
        parts.append(f"{says}:\n\n{pick(read(f'close_the_loop/{file}.csv'), NAMED)}")
    return "\n\n".join(parts)


def timing() -> str:
    plan = {name: name for name in ("what", "size", "precision", "horizon", "decay", "rows", "threads")}
    plan = {**plan, "median ms": "median_ms", "share of peak": "share_of_peak", "to upstream": "ratio_to_upstream"}
    diagnose = {"what": "what", "s of data": "seconds_of_data", "names": "names", "wall s": "wall_s", "per unit": "per"}
    env = {"task": "task", "what": "what", "physics steps / s": "physics_steps_per_s"}
    env |= {"control steps / s": "control_steps_per_s", "ControlEnv / this": "control_env_over_this"}
    pairs = (("time_planner", plan), ("time_diagnose", diagnose), ("benchmark_env", env))
    parts = [pick(read(f"timing/{file}.csv"), columns) for file, columns in pairs]
    floor = {"what": "what", "size": "size", "precision": "precision", "GFLOP": "gflop", "GB": "gbyte"}
    floor |= {"peak GFLOP/s": "peak_gflops", "peak GB/s": "peak_gbyte", "least ms": "floor_ms", "best ms": "best_ms"}
    least = pick(read("timing/roofline.csv"), floor)
    ways = {"size": "size", "critics": "members", "one by one [ms]": "loop_ms", "as one product [ms]": "batched_ms"}
    critics = pick(read("timing/time_ensemble.csv"), ways)
    parts += ["The least time that arithmetic and memory leave:", least, "Critics in an update:", critics]
    profile = {name: name for name in ("size", "precision", "operation", "ms", "calls")}
    large = [row for row in read("timing/profile_update.csv") if float(row["share"]) >= 0.03]
    shares = pick(large, {**profile, "share": ("share", percent)})
    return "\n\n".join([*parts, "Where an update's time goes:", shares, "On a GPU:", gpu()])


def gpu() -> str:
    """Networks with recorded work beside launched work, and what was measured once."""
    rows = read("timing/gpu_bench.csv")
    ways: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        if row["size"] and not row["success"] and not row["per_second"]:
            ways.setdefault((row["what"], row["size"], row["precision"]), {})[row["recorded"]] = row["median_ms"]
    head = ["what", "size", "precision", "recorded [ms]", "launched [ms]"]
    networks = table(head, [[*key, of["True"], of["False"]] for key, of in ways.items()])
    whole = next(row for row in rows if row["what"] == "pretrain push")
    steps = [row for row in rows if row["what"] == "environment steps"]
    says = [
        f"{r['count']} environments, physics={r['size']}: {int(r['per_second']):,} control steps a second"
        for r in steps
    ]
    says.append(
        f"pretraining push, {int(whole['count']):,} transitions: {float(whole['median_ms']) / 1000:.0f} s, "
        f"success {percent(whole['success'])}"
    )
    return "\n\n".join([f"{whole['device']}, PyTorch {whole['torch']}:", networks, "; ".join(says) + "."])


def records(*paths: str) -> str:
    """JSON files side by side, plain values only."""
    files = [json.loads((RESULTS / path).read_text()) for path in paths]
    flat = [{**d, **(d.get("robot") or {})} for d in files]
    leave = ("command", "cpu", "platform", "rrd", "frozen_sha256", "seed", "method", "task", "gap")
    keys = [k for k in dict.fromkeys(k for d in flat for k in d) if k not in leave]
    plain = [k for k in keys if not any(isinstance(d.get(k), dict | list) and d.get(k) for d in flat)]
    names = [Path(path).stem for path in paths]
    return table(["", *names], [[k, *(d.get(k, "") if d.get(k) is not None else "" for d in flat)] for k in plain])


def collect() -> str:
    head = {name: name for name in ("collector", "workers")}
    head |= {"start [s]": "start_s", "transitions / s": "steps_per_s", "to inline": "to_inline"}
    return pick(read("scale/time_collect.csv"), {**head, "bytes a transition": "bytes_per_step"})


def growth() -> str:
    """Plans by what they search, start-up times, and bytes of a rollout."""
    head: dict[str, str | tuple[str, Callable[[str], str]]]
    head = {"what": "what", "": "value", "takes": "amount", "unit": "unit", "to the default": "ratio"}
    return pick(read("scale/cost_growth.csv"), head)


def quality() -> str:
    head: dict[str, str | tuple[str, Callable[[str], str]]] = {"gap": "gap", "search": "variant"}
    head |= {"success": ("success", tenth), "low": ("success_low", tenth), "high": ("success_high", tenth)}
    head |= {"regret": "regret", "spread": "spread", "ms": "plan_ms"}
    parts = []
    for file in ("plan_quality", "decay"):
        rows = [{**r, "variant": r["variant"] or "as configured"} for r in read(f"plan_quality/{file}.csv")]
        parts.append(pick(rows, head))
    return "\n\n".join(parts)


def updates_per_s() -> float:
    """Updates of the small model on one thread, of as many slices as time_planner takes."""
    wanted = {"what": "update", "size": "small", "horizon": "3", "precision": "float32", "threads": "1"}
    row = next(r for r in read("timing/time_planner.csv") if wanted.items() <= r.items())
    return 1000 / float(row["median_ms"])


def thousand() -> str:
    """What a thousand workers would send and receive, by the arithmetic of one."""
    one = next(r for r in read("scale/time_collect.csv") if (r["collector"], r["workers"]) == ("process", "1"))
    rate, size, weights = (float(one[name]) for name in ("steps_per_s", "bytes_per_step", "weights_bytes"))
    round_s = float(one["median_s"])
    rows = [
        ["transitions a second", f"{1000 * rate:.3g}"],
        ["to the learner", f"{1000 * rate * size / 1e6:.0f} MB/s"],
        ["weights to the workers", f"{1000 * weights / 1e6:.0f} MB a round, {1000 * weights / round_s / 1e6:.0f} MB/s"],
        [
            "updates a second that 0.05 a transition asks for",
            f"{1000 * rate * 0.05:.3g}; by one worker {rate * 0.05:.3g}",
        ],
        ["updates a second of 256 slices that one core makes", f"{updates_per_s():.2g}"],
    ]
    return table(["1 000 workers", ""], rows)


def emps() -> str:
    head = {"data": "what", "verdict": "verdict", "named": "effects", "first half mm": "first_mm"}
    return pick(read("emps/emps.csv"), {**head, "second mm": "second_mm", "pulses mm": "pulses_mm", "s": "seconds"})


def healthy() -> str:
    """Return of each implementation, median and range over its seeds."""
    rows = read("healthy/healthy.csv")
    lines = []
    for method, ours in dict.fromkeys((row["method"], row["implementation"]) for row in rows):
        own = [row for row in rows if (row["method"], row["implementation"]) == (method, ours)]
        returns, steps = [float(row["return"]) for row in own], own[0]["steps"]
        cell = f"{median(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
        lines.append([f"`{method}`", ours, steps, own[0]["updates"], len(own), cell])
    return table(["method", "implementation", "steps", "updates", "seeds", "return"], lines)


def critic() -> str:
    head = {"critic": "critic", "puck at x [m]": "puck_x_m", "V": "value", "return": "return"}
    return pick(read("critic_profile/critic_profile.csv"), head)


def exact() -> str:
    head = {"gap": "gap", "H": "horizon", "reward": "reward", "episodes": "episodes", "success": ("success", percent)}
    return pick(read("exact_dynamics/exact_dynamics.csv"), head)


STUDIES: dict[str, Callable[[], str]] = {
    "pretrain": pretrain,
    "transfer": transfer,
    "outside": lambda: curves(read("outside/sgft.csv"), method_in_gap, "gap and method"),
    "tasks": tasks,
    "entry": lambda: curves(read("entry/sb3_sac.csv"), lambda r: r["name"], "environment"),
    "audit": audit,
    "ladder": ladder,
    "benchmark": benchmark,
    "paper": lambda: pick(read("paper/claims.csv"), {n: n for n in ("figure", "paper", "here", "verdict")}),
    "healthy": healthy,
    "horizon": lambda: curves(read("horizon/horizon.csv"), lambda r: r["variant"], "variant"),
    "pendulum": lambda: curves(read("pendulum/pendulum.csv"), lambda r: r["method"], "method"),
    "critic_profile": critic,
    "exact_dynamics": exact,
    "blind": blind,
    "foreign": foreign,
    "judgement": judgement,
    "emps": emps,
    "close_the_loop": loop,
    "stand_in": lambda: records("stand_in/stand_in.json", "stand_in/zero_shot.json"),
    "endure": lambda: records("endure/endure.json"),
    "franka_sim": lambda: records("franka_sim/franka_sim.json"),
    "stability": lambda: records("stability/stability.json"),
    "timing": timing,
    "plan_quality": quality,
    "scale": lambda: collect() + "\n\n" + growth(),
}


def study(name: str) -> str:
    """A section of the page: what the study's README says, its tables and pictures."""
    text = (RESULTS / name / "README.md").read_text()
    title, _, rest = text.removeprefix("# ").partition("\n")
    prose, _, facts = rest.partition("\n- command:")
    pictures = [f"![{p.stem}](results/{name}/{p.name})" for p in sorted((RESULTS / name).glob("*.png"))]
    parts = [f"## {title} {{ #{name} }}", prose.strip(), STUDIES[name](), *pictures, "- command:" + facts.strip("\n")]
    return "\n\n".join(parts)


def page() -> str:
    """All studies, as Markdown."""
    return "\n\n".join(study(name) for name in STUDIES)


def headline() -> str:
    """The table of the README."""
    scratch = [float(row["success"]) for row in read("pretrain/pretrain.csv")]
    took = [float(row["wall_seconds"]) / 60 for row in read("pretrain/pretrain.csv")]
    rows = [["push, pretrained", f"{spread(scratch)} in {median(took):.0f} min", "pretrain"]]
    runs = read("transfer/sgft.csv")
    for gap in dict.fromkeys(row["gap"] for row in runs):
        after = [
            [float(r["success"]) for r in runs if r["gap"] == gap and r["rollouts"] == n] for n in ("0", "10", "30")
        ]
        text = " → ".join(spread(values).replace(" %", "") for values in after) + " %"
        rows.append([f"`{gap}`, 0 → 10 → 30 rollouts", text, "transfer"])
    for task in TASKS:
        runs = read(f"tasks/{task}.csv")
        counts = sorted({int(r["rollouts"]) for r in runs})
        shown = [counts[0], counts[len(counts) // 2], counts[-1]]
        after = [[float(r["success"]) for r in runs if int(r["rollouts"]) == n] for n in shown]
        text = " → ".join(spread(values).replace(" %", "") for values in after) + " %"
        rows.append([f"`{runs[0]['gap']}`, {' → '.join(map(str, shown))}", text, "tasks"])
    score = {r["score"]: r for r in read("blind/blind.csv") if r["method"] == "diagnose"}
    top, false = score["single, clear: top 1"], score["no effect: false alarms"]
    rows.append(["diagnose, right name", f"{percent(top['value'])} of {top['of']}", "blind"])
    rows.append(["diagnose, false alarms", f"{percent(false['value'])} of {false['of']}", "blind"])
    closed = read("close_the_loop/close_the_loop.csv")
    before, after = ([float(r[f"zero_shot_{when}"]) for r in closed] for when in ("before", "after"))
    rows.append(
        ["zero-shot once diagnosed", f"{spread(before)} → {spread(after)}".replace(" %", "") + " %", "close_the_loop"]
    )
    lines = [[what, value, f"[data](results/{where})"] for what, value, where in rows]
    return table(["What", "Success, median (lowest–highest)", ""], lines)


def write_readme(path: Path) -> None:
    """Put the headline table between its markers."""
    text = path.read_text()
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    path.write_text(f"{text[:start]}\n{headline()}\n{text[end:]}")


def main() -> None:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--readme", action="store_true", help="rewrite the table of README.md instead of printing")
    if parser.parse_args().readme:
        write_readme(ROOT / "README.md")
    else:
        print(page())


if __name__ == "__main__":
    main()
