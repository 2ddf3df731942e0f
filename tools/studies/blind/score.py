"""Scores of reports against labels. A report is the dictionary that `diagnose` documents; nothing here runs it."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from mpc_sgft.runs.proportion import wilson

Report = Mapping[str, Any]
Label = Mapping[str, Any]
CLEAR = 2.0  # singles at least this many times detectable count for the names
NEAR = 1.15  # held-out error within 15 % of the oracle's


class Score(NamedTuple):
    """A share with its 95 % Wilson interval, and what issue or reader wants of it."""

    name: str
    hits: float
    count: int
    low: float
    high: float
    goal: str

    @property
    def value(self) -> float:
        return self.hits / self.count if self.count else float("nan")


def named(report: Report) -> list[str]:
    """Names that the report asserts, sorted, each once; none unless the verdict is `effect`."""
    return sorted({e["name"] for e in report["effects"]}) if report["verdict"] == "effect" else []


def asserted(report: Report) -> list[str]:
    """Names that the report holds for certain: those that it asserts, or, among ties, those in every tied set."""
    if report["verdict"] != "not_identifiable":
        return named(report)
    tied = [set(names) for names in ties(report)]
    return sorted(set.intersection(*tied)) if tied else []


def truths(label: Label) -> list[list[str]]:
    """Sets of names that are right: the hidden one, and those that the equations of motion cannot tell from it."""
    return [sorted(e["name"] for e in label["effects"]), *[sorted(names) for names in label["equivalents"]]]


def top1(report: Report, label: Label) -> bool:
    """Whether the verdict is right: the hidden effects by name, or a tie of them with what nobody could tell apart."""
    return rightly_tied(report, label) or named(report) in truths(label)


def rightly_tied(report: Report, label: Label) -> bool:
    """Whether the hidden effects are in a tie, and nothing else is but equivalents and names alike on these data."""
    tied, right = ties(report), truths(label)
    allowed = [*right, *(sorted(names) for names in label["alike"])]
    honest = report["verdict"] == "not_identifiable" and len(tied) > 1
    return honest and right[0] in tied and all(names in allowed for names in tied)


def top3(report: Report, label: Label) -> bool:
    """Whether the hidden effects are among the three best candidates."""
    ranked = [names_of(c) for c in report["candidates"][:3]]
    return top1(report, label) or any(names in truths(label) for names in ranked)


def names_of(candidate: Any) -> list[str]:
    """Names in a candidate or tie: {"effects": [...]}, a list, or one name; entries are names, labels or mappings."""
    entries = candidate.get("effects", [candidate.get("name")]) if isinstance(candidate, Mapping) else candidate
    entries = [entries] if isinstance(entries, str) else entries
    names = [e["name"] if isinstance(e, Mapping) else str(e).split("@")[0] for e in entries if e]
    return sorted(set(names))


def ties(report: Report) -> list[list[str]]:
    """Sets of names that the report holds for equally good: what it puts first, and what ties with that."""
    return [s for s in [names_of(report["effects"]), *(names_of(tie) for tie in report.get("ties", []))] if s]


def places_right(report: Report, label: Label) -> bool:
    """Whether the hidden effects are named, at the places where they are."""
    said = sorted((e["name"], tuple(_list(e.get("at")))) for e in report["effects"])
    true = sorted((e["name"], tuple(e["at"])) for e in label["effects"])
    return report["verdict"] == "effect" and said == true


def _list(at: Any) -> list[str]:
    return [at] if isinstance(at, str) else list(at or [])


def f1(report: Report, label: Label) -> float:
    """Harmonic mean of precision and recall of the names held for certain; the kindest of the equivalent truths.

    One for a tie that is right.
    """
    if rightly_tied(report, label):
        return 1.0
    said = set(asserted(report))
    return max(2 * len(said & set(right)) / max(len(said) + len(right), 1) for right in truths(label))


def covered(report: Report, label: Label) -> list[bool]:
    """For each parameter of a rightly named effect, whether its interval holds the truth."""
    said = {e["name"]: e["parameters"] for e in report["effects"]} if report["verdict"] == "effect" else {}
    inside = []
    for effect in label["effects"]:
        for name, value in effect["parameters"].items():
            got = said.get(effect["name"], {}).get(name)
            if got is not None and got["low"] is not None and got["high"] is not None:
                inside.append(bool(got["low"] <= value <= got["high"]))
    return inside


def clear(label: Label) -> bool:
    return all(e["multiple"] >= CLEAR for e in label["effects"])


def near_oracle(report: Report, oracle: Report) -> bool | None:
    """Whether the repaired held-out error is within 15 % of the oracle's; None where one of them has none."""
    ours, best = (r.get("held_out", {}).get("repaired") for r in (report, oracle))
    return None if ours is None or best is None else bool(ours <= NEAR * best)


def share(name: str, hits: Iterable[bool | float], goal: str) -> Score:
    values = [float(h) for h in hits]
    return Score(name, sum(values), len(values), *wilson(sum(values), len(values)), goal)


def table(
    reports: Mapping[str, Report], hidden: Mapping[str, Label], oracles: Mapping[str, Report] | None = None
) -> list[Score]:
    """Every score of the benchmark.

    Args:
        reports: By case name; cases without a report are left out (and counted in the first row).
        hidden: Labels by case name.
        oracles: Reports of runs that were told the true names.
    """
    there = [(reports[n], label, n) for n, label in hidden.items() if n in reports]

    def of(group: str, also: Callable[[Label], bool] = lambda label: True) -> list[tuple[Report, Label, str]]:
        return [x for x in there if x[1]["group"] == group and also(x[1])]

    single = of("single", clear)
    both = of("pair")
    around = [near_oracle(r, oracles[n]) for r, _, n in of("single") if oracles and n in oracles]
    parameters = [ok for r, label, _ in there if label["group"] in ("single", "pair") for ok in covered(r, label)]
    return [
        share("finished without an error", [r["verdict"] != "error" for r, _, _ in there], "1"),
        share("single, clear: top 1", [top1(r, y) for r, y, _ in single], ">= 0.90"),
        share("single, clear: top 3", [top3(r, y) for r, y, _ in single], ">= 0.98"),
        share("single, clear: named, no tie", [named(r) in truths(y) for r, y, _ in single], ""),
        share("single, clear: name and place", [places_right(r, y) for r, y, _ in single], ""),
        share("single, all sizes: top 1", [top1(r, y) for r, y, _ in of("single")], ""),
        share("pairs: F1 of the set of names", [f1(r, y) for r, y, _ in both], ">= 0.80"),
        share("no effect: false alarms", [bool(asserted(r)) for r, _, _ in of("none")], "<= 0.05, of at least 100"),
        share("no effect: verdict none", [r["verdict"] == "none" for r, _, _ in of("none")], ""),
        share("outside the library: a wrong name", [bool(asserted(r)) for r, _, _ in of("outside")], "<= 0.10"),
        share("outside the library: verdict unknown", [r["verdict"] == "unknown" for r, _, _ in of("outside")], ""),
        share("not identifiable: said so", [honest(r, y) for r, y, _ in of("ambiguous")], ""),
        share("not identifiable: a wrong name", [misled(r, y) for r, y, _ in of("ambiguous")], ""),
        share("single: repaired within 15 % of the oracle", [x for x in around if x is not None], ">= 0.90"),
        share("90 % intervals that cover the truth", parameters, "0.80 to 0.97"),
    ]


def honest(report: Report, label: Label) -> bool:
    """Whether the report says that it cannot know.

    For too little data, that there is nothing to see will do; for names that are one term of the equations, one of them
    by convention, if the report lists another as tied.
    """
    right = truths(label)
    if report["verdict"] == "effect" and named(report) in right:
        return any(names in right and names != named(report) for names in ties(report))
    return report["verdict"] == "not_identifiable" or (label["kind"] == "short" and report["verdict"] == "none")


def misled(report: Report, label: Label) -> bool:
    return report["verdict"] == "effect" and named(report) not in truths(label)
