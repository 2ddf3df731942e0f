"""Reports of a benchmark in one file, so that hours of work outlive the folder they were made in."""

import gzip
import json
from pathlib import Path

from mpc_sgft.storage.whole_file import write_whole
from tools.studies.blind import cases
from tools.studies.blind.solve import reports

KINDS = ("reports", "oracle")


def pack(out: Path, target: Path) -> int:
    """Write all reports that are there, with the labels' seed and hashes but not the labels; how many there are."""
    head = {"seed": cases.seed_of(out), "labels": cases.label_hashes(out)}
    rows = [{"kind": k, "case": name, "report": r} for k in KINDS for name, r in reports(out, k).items()]
    lines = "".join(json.dumps(x) + "\n" for x in [head, *rows])
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(gzip.compress(lines.encode(), mtime=0))  # the same bytes for the same reports
    return len(rows)


def unpack(source: Path, out: Path) -> tuple[int, int]:
    """Put packed reports beside the cases that they are of; those that are there are kept.

    Processors round differently, and a simulation may amplify that: a report counts for the case of the same label.

    Returns:
        How many came, and how many were left out because their case has another label here.

    Raises:
        ValueError: If they are of another seed.
    """
    head, *rows = [json.loads(x) for x in gzip.decompress(source.read_bytes()).decode().splitlines()]
    if (seed := cases.seed_of(out)) != head["seed"]:
        raise ValueError(
            f"{source} holds reports on cases of seed {head['seed']}, and {out} holds cases of seed {seed}. Give the "
            "--out of those cases, or another --pack."
        )
    here = cases.label_hashes(out)
    same = [row for row in rows if here.get(row["case"]) == head["labels"][row["case"]]]
    new = 0
    for row in same:
        path = out / row["kind"] / row["case"] / "blind.json"
        if not path.is_file():
            write_whole(path, json.dumps(row["report"]).encode())
            new += 1
    return new, len(rows) - len(same)
