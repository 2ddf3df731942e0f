"""What the studies share: many runs, each in a process of its own, and a CSV that goes on where it stopped.

Not run by itself. A run whose summary is there is not made again, one that was cut off is resumed; a row whose key is
in the CSV is not measured again.
"""

import csv
import io
import itertools
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from mpc_sgft.storage.whole_file import write_whole

Job = TypeVar("Job")
NEEDED = {"gap", "method", "variant", "seed", "rollouts", "success"}  # columns of learning curves
Runs = dict[str, dict[str, dict[int, dict[int, dict[str, str]]]]]  # gap -> method -> seed -> rollouts -> row


class RunFailed(Exception):
    """A run of a study ended with an error; the message holds the end of what it said."""


def finished(
    command: str, folder: Path, overrides: Sequence[str], launcher: str | None = None, first: Sequence[str] = ()
) -> dict[str, Any]:
    """The summary of `python -m mpc_sgft.COMMAND` in a run folder: read if it is there, else run or resumed.

    Args:
        command: Which.
        folder: The run folder; with a launcher, where the other machines see it too.
        overrides: Of the run, and of the launcher.
        launcher: A Hydra launcher that starts the run elsewhere; None: here. It does not resume what was cut off.
        first: More overrides, where it begins; another time they need not be the same.

    Raises:
        RunFailed: If the command does, if the folder is of a run with other overrides, or its summary cannot be read.
    """
    asked_before(folder, [command, *(word for word in overrides if not word.lstrip("+").startswith("hydra."))])
    summary = folder / "summary.json"
    if not summary.exists():
        words = [f"run_dir={folder}", "quiet=true", *overrides, *first]
        begun = (folder / "config.yaml").exists()
        if launcher is not None and begun:
            raise RunFailed(
                f"{folder}: begun and not finished. Wait for it, or remove it; without a launcher it goes on."
            )
        if launcher is not None:
            words = ["-m", f"hydra/launcher={launcher}", f"hydra.sweep.dir={folder}.sweep", *words]
        words = ["--resume", str(folder)] if begun else words
        line = [sys.executable, "-m", f"mpc_sgft.{command}", *words]
        done = subprocess.run(line, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
        if done.returncode:
            raise RunFailed(f"{folder}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    try:
        return json.loads(summary.read_text())
    except json.JSONDecodeError as error:
        raise RunFailed(f"{summary} cannot be read ({error}): remove it, and the run is resumed.") from error


def asked_before(folder: Path, words: Sequence[str]) -> None:
    """Note beside a folder that is not there yet what is asked of it; one that is must have been asked the same.

    Raises:
        RunFailed: If that was something else, or was not noted.
    """
    kept = folder.with_name(f"{folder.name}.asked")
    if not folder.exists():
        write_whole(kept, "".join(f"{word}\n" for word in words).encode())
        return
    before = kept.read_text().splitlines() if kept.exists() else ["unknown settings"]
    if before != [*words]:
        raise RunFailed(
            f"{folder} was made with {' '.join(before)}, asked for is {' '.join(words)}. "
            "Give another --runs, or remove it."
        )


def first_mean(folder: Path, column: str, rows: int) -> float | None:
    """Mean of a column over the first rows of a run's metrics.csv; None where they hold no number."""
    with (folder / "metrics.csv").open(newline="") as file:
        found = [row.get(column) for row in itertools.islice(csv.DictReader(file), rows)]
    numbers = [float(text) for text in found if text]
    return sum(numbers) / len(numbers) if numbers else None


def each(jobs: Sequence[Job], work: Callable[[Job], dict[str, Any]], side_by_side: int) -> tuple[list[dict], int]:
    """What `work` makes of each job, in their order, and how many failed; what failed is printed."""

    def tried(job: Job) -> dict[str, Any] | None:
        try:
            return work(job)
        except RunFailed as error:
            print(error, file=sys.stderr, flush=True)
            return None

    with ThreadPoolExecutor(side_by_side) as pool:
        found = list(pool.map(tried, jobs))
    results = [result for result in found if result is not None]
    return results, len(found) - len(results)


def write(path: Path, columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> None:
    """A whole CSV, its folder made if need be."""
    file = io.StringIO(newline="")
    table = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_whole(path, file.getvalue().encode())


def measured(path: Path, columns: Sequence[str], keys: Sequence[dict[str, Any]], work: Callable[..., dict]) -> None:
    """Rows of a CSV, one a key, each on disk as soon as it is measured; a key that has a row is left alone.

    Args:
        path: The CSV.
        columns: Its columns, those of the keys among them.
        keys: What to measure; `work(**key)` gives the row.
        work: Measures one.

    Raises:
        ValueError: If the file there has other columns.
    """
    rows: list[dict[str, Any]] = []
    if path.exists():
        with path.open(newline="") as file:
            table = csv.DictReader(file)
            rows = list(table)
            if list(table.fieldnames or []) != list(columns):
                raise ValueError(f"{path} has the columns {table.fieldnames}, not {list(columns)}: give another file")
    for key in keys:
        if any(all(str(row[name]) == str(value) for name, value in key.items()) for row in rows):
            continue
        rows.append(work(**key))
        write(path, columns, rows)
        print(rows[-1], flush=True)


def read_curves(paths: Iterable[Path]) -> Runs:
    """Rows of curves as tools.studies.study writes them; a variant is part of a method's name (`named`).

    Raises:
        ValueError: If a file lacks a column, or two hold the same run.
    """
    runs: Runs = defaultdict(lambda: defaultdict(lambda: defaultdict(dict)))
    for path in paths:
        with path.open(newline="") as file:
            table = csv.DictReader(file)
            missing = NEEDED - set(table.fieldnames or [])
            if missing:
                raise ValueError(
                    f"{path} has no column {', '.join(sorted(missing))}; curves have {', '.join(sorted(NEEDED))}"
                )
            for row in table:
                method = named(row["method"], row["variant"])
                curve, count = runs[row["gap"]][method][int(row["seed"])], int(row["rollouts"])
                if count in curve:
                    raise ValueError(
                        f"{path}: {method} in {row['gap']}, seed {row['seed']}, is there twice; give it once"
                    )
                curve[count] = row
    return runs


def named(method: str, variant: str) -> str:
    return f"{method} {variant}".strip()
