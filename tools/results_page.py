"""Tables of results/, for the documentation and the README; none is typed by hand.

    python -m tools.results_page --readme          # rewrite the headline table of README.md

`docs/results.md` is filled when the site is built (tools/docs_hooks.py).
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

from tools import diagnose_tables, policy_tables, timing_tables
from tools.ladder_table import ladder
from tools.tables import RESULTS, ROOT, Row, curves, percent, pick, read, spread, table

BEFORE_WIN_STAY = ("push_towel", "rope_peg_in_hole")  # tasks whose row of the headline is of before it, marked †
BEGIN, END = "<!-- headline:begin -->", "<!-- headline:end -->"


def records(*paths: str) -> str:
    """JSON files side by side, plain values only."""
    files = [json.loads((RESULTS / path).read_text()) for path in paths]
    flat = [{**d, **(d.get("robot") or {})} for d in files]
    leave = ("command", "cpu", "platform", "rrd", "frozen_sha256", "seed", "method", "task", "gap")
    keys = [k for k in dict.fromkeys(k for d in flat for k in d) if k not in leave]
    plain = [k for k in keys if not any(isinstance(d.get(k), dict | list) and d.get(k) for d in flat)]
    names = [Path(path).stem for path in paths]
    return table(["", *names], [[k, *(d.get(k, "") if d.get(k) is not None else "" for d in flat)] for k in plain])


STUDIES: dict[str, Callable[[], str]] = {
    "pretrain": policy_tables.pretrain,
    "transfer": policy_tables.transfer,
    "outside": policy_tables.outside,
    "tasks": policy_tables.tasks,
    "once": policy_tables.once,
    "entry": lambda: curves(read("entry/sb3_sac.csv"), lambda r: r["name"], "environment"),
    "audit": policy_tables.audit,
    "ladder": ladder,
    "benchmark": policy_tables.benchmark,
    "paper": lambda: pick(read("paper/claims.csv"), {n: n for n in ("figure", "paper", "here", "verdict")}),
    "healthy": policy_tables.healthy,
    "horizon": lambda: curves(read("horizon/horizon.csv"), lambda r: r["variant"], "variant"),
    "pendulum": lambda: curves(read("pendulum/pendulum.csv"), lambda r: r["method"], "method"),
    "critic_profile": policy_tables.critic,
    "exact_dynamics": policy_tables.exact,
    "blind": diagnose_tables.blind,
    "foreign": diagnose_tables.foreign,
    "judgement": diagnose_tables.judgement,
    "emps": diagnose_tables.emps,
    "close_the_loop": policy_tables.loop,
    "stand_in": lambda: records("stand_in/stand_in.json", "stand_in/zero_shot.json"),
    "endure": lambda: records("endure/endure.json"),
    "franka_sim": lambda: records("franka_sim/franka_sim.json"),
    "stability": lambda: records("stability/stability.json"),
    "timing": timing_tables.timing,
    "plan_quality": timing_tables.quality,
    "scale": lambda: timing_tables.collect() + "\n\n" + timing_tables.growth(),
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


def over_rollouts(runs: list[Row], counts: Sequence[int]) -> str:
    """Success after each number of rollouts, over all runs."""
    after = [[float(row["success"]) for row in runs if int(row["rollouts"]) == n] for n in counts]
    return " → ".join(spread(values).replace(" %", "") for values in after) + " %"


def headline() -> str:
    """The table of the README."""
    scratch = [float(row["success"]) for row in read("pretrain/pretrain.csv")]
    took = [float(row["wall_seconds"]) / 60 for row in read("pretrain/pretrain.csv")]
    rows = [["push, pretrained", f"{spread(scratch)} in {median(took):.0f} min", "pretrain"]]
    runs = read("transfer/sgft.csv")
    for gap in dict.fromkeys(row["gap"] for row in runs):
        text = over_rollouts([row for row in runs if row["gap"] == gap], (0, 10, 30))
        rows.append([f"`{gap}`, 0 → 10 → 30 rollouts", text, "transfer"])
    for task in policy_tables.TASKS:
        folder, name = ("benchmark", "rope") if task == "rope_peg_in_hole" else ("tasks", task)  # more seeds
        runs = [row for row in read(f"{folder}/{name}.csv") if row["method"] == "sgft"]
        counts = sorted({int(r["rollouts"]) for r in runs})
        shown = [counts[0], counts[len(counts) // 2], counts[-1]]
        what = f"`{runs[0]['gap']}`{'†' * (task in BEFORE_WIN_STAY)}, {' → '.join(map(str, shown))}"
        rows.append([what, over_rollouts(runs, shown), folder])
    rows.append(["5 kept aside, 0 → 10 → 20", over_rollouts(read("once/once.csv"), (0, 10, 20)), "once"])
    score = {r["score"]: r for r in read("blind/blind.csv") if r["method"] == "diagnose"}
    top, named = score["single, clear: top 1"], score["single, clear: named, no tie"]
    false = score["no effect: false alarms"]
    said = f"{percent(named['value'])} of {named['of']} named, {percent(top['value'])} with right ties"
    rows.append(["diagnose, one clear effect", said, "blind"])
    rows.append(["diagnose, false alarms", f"{percent(false['value'])} of {false['of']}", "blind"])
    closed = read("close_the_loop/close_the_loop.csv")
    before, after = ([float(r[f"zero_shot_{when}"]) for r in closed] for when in ("before", "after"))
    said = f"{spread(before)} → {spread(after)}".replace(" %", "") + " %"
    rows.append(["30 rollouts, diagnosis, retraining", said, "close_the_loop"])
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
