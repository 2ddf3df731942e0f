"""Runs `diagnose` on the case folders. This file, and the processes that it starts, never open the labels.

Beside the full run, a case can be run as the *oracle*: the same fitter, told the true names. Its names arrive in a file
of their own that is written only after all full runs are done.
"""

import json
import time
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any


def solve(case: Path, out: Path, names: list[str] | None = None, seed: int = 0) -> dict[str, Any]:
    """One run of the solver on one case; the report goes to `out`/blind.json.

    Args:
        case: Folder with model.xml, known.json and episodes.
        out: Folder of the report.
        names: Restrict it to these effects (the oracle); None for the whole library.
        seed: Of the solver.

    Returns:
        The report as a dictionary; {"verdict": "error", "error": …} if the solver raised.
    """
    from mpc_sgft.diagnose import diagnose

    out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    try:
        report = diagnose(
            case / "model.xml",
            sorted(case.glob("episode_*.csv")),
            out=None,  # its pages and recordings are not scored, and take a fifth of the time
            effects=names,
            signals=None,
            window=None,
            held_out=None,
            seed=seed,
            max_effects=len(names) if names else 3,
            **known(case),
        ).as_dict()
    except Exception as error:  # a crash is a result of the benchmark, with its trace beside it
        (out / "traceback.txt").write_text(traceback.format_exc())
        report = {"verdict": "error", "error": f"{type(error).__name__}: {error}", "effects": [], "candidates": []}
    report["wall_seconds"] = time.perf_counter() - began
    partial = out / "blind.json.part"
    partial.write_text(json.dumps(report))
    partial.rename(out / "blind.json")  # complete or absent, so that a killed run resumes
    return report


def known(case: Path) -> dict[str, Any]:
    """What the user of a case knows, as arguments of `diagnose`."""
    said = json.loads((case / "known.json").read_text())
    return {"uncertain": said["uncertain"] or None, "tolerance": said.get("tolerance")}


def solve_all(
    folders: Iterable[tuple[Path, Path, list[str] | None]], jobs: int, progress: Callable[[int], object]
) -> None:
    """All runs that are not on disk yet, on `jobs` processes.

    Args:
        folders: Case folder, output folder, names or None, as for `solve`.
        jobs: Processes.
        progress: Called with 1 for each run that is there.
    """
    todo = []
    for case, out, names in folders:
        if (out / "blind.json").is_file():
            progress(1)
        else:
            todo.append((case, out, names))
    if jobs == 1:
        for case, out, names in todo:
            solve(case, out, names)
            progress(1)
        return
    with ProcessPoolExecutor(jobs) as pool:
        futures = [pool.submit(solve, *one) for one in todo]
        for future in as_completed(futures):
            future.result()
            progress(1)


def reports(out: Path, kind: str = "reports") -> dict[str, dict[str, Any]]:
    """What the solver said, by case name; only finished runs."""
    found = sorted((out / kind).glob("*/blind.json"))
    return {path.parent.name: json.loads(path.read_text()) for path in found}
