"""Scores of one foreign ground: does `diagnose` name what matters where nothing is exactly as the model says?

The label of a case holds the effects that move predictions by more than the tolerance; everything else in it is
imperfection. Names that the equations cannot tell apart are one name (see blind/score), and so is a simpler effect that
does for a richer one within half of what matters, as docs/reference/relevance.md promises it.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from tools.studies.blind.score import CLEAR, Label, Report, asserted, covered, f1, named, share, ties, top1, truths

SIMPLER = {"stribeck_friction": "coulomb_friction", "asymmetric_friction": "viscous_friction"}


class Line(NamedTuple):
    """A score with its 95 % interval, of how many cases, and what is to be reached."""

    score: str
    value: float
    low: float
    high: float
    of: int
    goal: str


def fair(label: Label) -> dict[str, Any]:
    """The label with sets as good as the hidden one where a simpler effect would do."""
    own = {e["name"] for e in label["effects"]}
    enough = [s for s in label["alike"] if all(SIMPLER.get(n) in s for n in own - set(s))]
    return {**label, "equivalents": [*label["equivalents"], *(s for s in enough if s not in label["equivalents"])]}


def main_effect(label: Label) -> str:
    """The hidden effect that changes most."""
    return max(label["effects"], key=lambda e: e["weight"])["name"]


def stand_ins(label: Label, name: str, sets: Iterable[Iterable[str]]) -> set[str]:
    """A hidden name, and those that take its place in some of these sets, the other hidden names unchanged."""
    own = {e["name"] for e in label["effects"]}
    return {name} | {n for s in sets if own - {name} <= set(s) for n in set(s) - own}


def main_right(report: Report, label: Label) -> bool:
    """Whether the effect with the largest share is the main one, or ties are only about what to call it."""
    name = main_effect(label)
    right = stand_ins(label, name, truths(label))
    if report["verdict"] == "effect":
        return max(report["effects"], key=lambda e: e["share"]["value"])["name"] in right
    allowed = right | stand_ins(label, name, label["alike"])
    tied = [set(names) for names in ties(report)] if report["verdict"] == "not_identifiable" else []
    return len(tied) > 1 and all(s & allowed for s in tied) and any(s & right for s in tied)


def reduction(report: Report) -> float | None:
    """By which share the repair lowers the held-out error of the worst signal; None without a repair."""
    return report.get("held_out", {}).get("reduction") if named(report) else None


def middle(name: str, values: list[float], goal: str = "") -> Line:
    """A median, and order statistics that hold it with 95 %."""
    x, n = np.sort(values), len(values)
    if not n:
        return Line(name, float("nan"), float("nan"), float("nan"), 0, goal)
    low = max(int(np.floor(n / 2 - 0.98 * np.sqrt(n))), 0)
    return Line(name, float(np.median(x)), float(x[low]), float(x[n - 1 - low]), n, goal)


def table(reports: Mapping[str, Report], hidden: Mapping[str, Label]) -> list[Line]:
    """Every score of one ground; cases without a report are left out.

    Args:
        reports: By case name.
        hidden: Labels by case name.
    """
    there = [(reports[n], fair(label)) for n, label in hidden.items() if n in reports]
    group = {g: [x for x in there if x[1]["group"] == g] for g in ("single", "pair", "none", "outside")}
    single, both = [x for x in group["single"] if all(e["left"] >= CLEAR for e in x[1]["effects"])], group["pair"]
    shares = [
        share("finished without an error", [r["verdict"] != "error" for r, _ in there], "1"),
        share("single, clear: main effect right", [main_right(r, y) for r, y in single], ">= 0.95"),
        share("single, clear: exact set", [top1(r, y) for r, y in single], ">= 0.85"),
        share("pairs: main effect right", [main_right(r, y) for r, y in both], ""),
        share("pairs: exact set", [top1(r, y) for r, y in both], ""),
        share("pairs: F1 of the set of names", [f1(r, y) for r, y in both], ">= 0.80"),
        share("nothing that matters: false alarms", [bool(asserted(r)) for r, _ in group["none"]], "<= 0.05"),
        share("nothing that matters: verdict none", [r["verdict"] == "none" for r, _ in group["none"]], ""),
        share("outside the library: a wrong name", [bool(asserted(r)) for r, _ in group["outside"]], "<= 0.10"),
        share("outside the library: verdict unknown", [r["verdict"] == "unknown" for r, _ in group["outside"]], ""),
        share("90 % intervals that cover the truth", [ok for r, y in single + both for ok in covered(r, y)], ""),
    ]
    lines = [Line(s.name, s.value, s.low, s.high, s.count, s.goal) for s in shares]
    gained = [x for r, _ in single + both if (x := reduction(r)) is not None]
    spent = [r["wall_seconds"] for r, _ in there if "wall_seconds" in r]
    return [*lines, middle("held-out error taken away, median", gained), middle("seconds, median", spent)]


def row(name: str, label: Label, report: Report) -> dict[str, Any]:
    """One case, for the CSV."""
    label, asked = fair(label), label["group"] in ("single", "pair")
    return {
        "case": name,
        **{k: label[k] for k in ("group", "plant", "seconds", "noise_level", "force_channel")},
        "truth": " ".join(f"{e['name']}@{','.join(e['at'])}x{e['multiple']:.2f}" for e in label["effects"]),
        "equal": " | ".join("+".join(s) for s in truths(label)[1:]),
        "alike": " | ".join("+".join(s) for s in label["alike"]),
        "verdict": report["verdict"],
        "said": " ".join(f"{e['name']}:{e['share']['value']:.2g}" for e in report["effects"]),
        "traces": " ".join(e["name"] for e in report.get("traces", [])),
        "main_right": main_right(report, label) if asked else "",
        "exact": top1(report, label) if asked else "",
        "reduction": "" if (x := reduction(report)) is None else round(x, 4),
        "seconds_spent": round(report.get("wall_seconds", float("nan")), 2),
    }
