"""Reports of a benchmark in one file, so that hours of work outlive the folder they were made in."""

import gzip
import json
from pathlib import Path

from tools.blind import cases
from tools.blind.solve import reports

KINDS = ("reports", "oracle")


def pack(out: Path, target: Path) -> int:
    """Write all reports that are there, with the labels' seed and hash but not the labels; how many there are."""
    head = {"seed": cases.seed_of(out), "labels_sha256": _hash(out)}
    rows = [{"kind": k, "case": name, "report": r} for k in KINDS for name, r in reports(out, k).items()]
    lines = "".join(json.dumps(x) + "\n" for x in [head, *rows])
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(gzip.compress(lines.encode(), mtime=0))  # the same bytes for the same reports
    return len(rows)


def unpack(source: Path, out: Path) -> int:
    """Put packed reports beside the cases that they are of; those that are there are kept. How many came.

    Raises:
        ValueError: If they are of other cases.
    """
    head, *rows = [json.loads(x) for x in gzip.decompress(source.read_bytes()).decode().splitlines()]
    if (there := _hash(out)) != head["labels_sha256"]:
        raise ValueError(
            f"{source} holds reports on cases of seed {head['seed']} with labels {head['labels_sha256'][:16]}…, "
            f"and {out} holds cases of seed {cases.seed_of(out)} with labels {there[:16]}…. Give the --out of those "
            "cases, or another --pack."
        )
    new = 0
    for row in rows:
        path = out / row["kind"] / row["case"] / "blind.json"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(row["report"]))
            new += 1
    return new


def _hash(out: Path) -> str:
    return (out / "labels.sha256").read_text().strip()
