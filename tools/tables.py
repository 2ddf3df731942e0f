"""Markdown tables of the CSVs of results/: what every study's table is made of."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
Row = dict[str, str]


def read(path: str) -> list[Row]:
    """Rows of a CSV of results/."""
    with (RESULTS / path).open(newline="") as file:
        return list(csv.DictReader(file))


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def percent(value: str | float) -> str:
    return f"{100 * float(value):.0f} %"


def spread(values: Sequence[float]) -> str:
    """Median, and lowest to highest where there are several, of shares."""
    middle = f"{100 * median(values):.0f}"
    return f"{middle} % ({100 * min(values):.0f}–{100 * max(values):.0f})" if len(set(values)) > 1 else f"{middle} %"


def curves(rows: list[Row], key: Callable[[Row], str], name: str) -> str:
    """Success after each number of rollouts, a line a key: median (lowest-highest) over the seeds."""
    counts = sorted({int(row["rollouts"]) for row in rows})
    lines = []
    for group in dict.fromkeys(map(key, rows)):
        mine = [row for row in rows if key(row) == group]
        seeds = len({row["seed"] for row in mine})
        cells = [[float(r["success"]) for r in mine if int(r["rollouts"]) == n] for n in counts]
        lines.append([group, seeds, *(spread(values) if values else "" for values in cells)])
    return table([name, "seeds", *(f"{n} rollouts" for n in counts)], lines)


def pick(rows: list[Row], columns: Mapping[str, str | tuple[str, Callable[[str], str]]]) -> str:
    """Some columns of a CSV as they are, {heading: column or (column, how to write it)}."""
    how = {head: what if isinstance(what, tuple) else (what, str) for head, what in columns.items()}
    return table(list(how), [[write(row[name]) if row[name] else "" for name, write in how.values()] for row in rows])


def tenth(value: str) -> str:
    return f"{100 * float(value):.1f} %"


def minutes(value: str) -> str:
    return f"{float(value) / 60:.1f}"


def digits(value: str) -> str:
    return f"{float(value):.4g}"
