"""Columns of other names, units and signs: what each column of ours is made of."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Table

UNITS = {
    "": 1.0,
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": np.pi / 180,
    "rev": 2 * np.pi,
    "rpm": 2 * np.pi / 60,
    "rad/s": 1.0,
    "deg/s": np.pi / 180,
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "m/s": 1.0,
    "mm/s": 1e-3,
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "N": 1.0,
    "mN": 1e-3,
    "Nm": 1.0,
    "mNm": 1e-3,
    "A": 1.0,
    "mA": 1e-3,
    "V": 1.0,
}
FORM = "[FACTOR*]COLUMN[ UNIT][ + OFFSET]"
EXAMPLE = "{}=-2*enc deg + 0.1"
KINDS = ("time", "ctrl/", "qpos/", "qvel/", "force/", "sensor/")
PATTERN = re.compile(
    r"""^\s*(?:(?P<factor>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*\*\s*|(?P<minus>-)\s*)?
    (?P<column>.+?)
    (?:\s+(?P<unit>[A-Za-z]+(?:/s)?))?
    (?:\s+(?P<sign>[-+])\s+(?P<offset>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?))?\s*$""",
    re.VERBOSE,
)


class Source(NamedTuple):
    """What a column of ours is made of: `factor` x a file's column + `offset`, in SI units."""

    column: str
    factor: float
    offset: float


def read_mapping(given: str) -> dict[str, Source]:
    """A mapping from a yaml file, or from the text itself: `qpos/elbow=enc deg,ctrl/m=-0.11*current`.

    Raises:
        UserError: If it cannot be read, or names something that is none of our columns.
    """
    if Path(given).suffix.lower() in (".yaml", ".yml"):
        entries = _from_file(Path(given))
    else:
        parts = (item.partition("=") for item in given.split(",") if item.strip())
        entries = {name.strip(): value.strip() for name, _, value in parts}
    return parse_mapping(entries)


def parse_mapping(entries: Mapping[str, str | Source]) -> dict[str, Source]:
    """{our column: FORM}.

    Raises:
        UserError: For a column that is none of ours, or a source that is not of that form.
    """
    out = {}
    for name, text in entries.items():
        if name != "time" and not name.startswith(KINDS[1:]):
            raise UserError(f"--map {name}: our columns are time, ctrl/…, qpos/…, qvel/…, force/… and sensor/….")
        if isinstance(text, Source):
            out[name] = text
            continue
        match = PATTERN.match(text)
        if not match:
            raise UserError(f"--map {name}={text}: write {name}={FORM}, such as {EXAMPLE.format(name)}.")
        column, unit = match["column"], match["unit"] or ""
        if unit not in UNITS:  # a column may have a name of several words
            column, unit = f"{column} {unit}", ""
        factor = float(match["factor"] or (-1.0 if match["minus"] else 1.0)) * UNITS[unit]
        offset = float(match["offset"] or 0.0) * (-1 if match["sign"] == "-" else 1)
        out[name] = Source(column, factor, offset)
    return out


def mapped(table: Table, mapping: Mapping[str, Source]) -> Table:
    """The table with our columns beside its own; those that something is made of are left out.

    Raises:
        UserError: If the file lacks a column.
    """
    has = table.columns
    for name, source in mapping.items():
        if source.column not in has:
            near = get_close_matches(source.column, has, 1, 0.5)
            hint = f" Is it {near[0]!r}?" if near else ""
            if any(sign in source.column for sign in ("*", "+", " -")):
                hint = f" Write {name}={FORM}, such as {EXAMPLE.format(name)}."
            raise UserError(
                f"{table.name}: --map {name}: no column {source.column!r}.{hint} The file has: {', '.join(has)}."
            )
    used = {source.column for source in mapping.values()}
    left = {n: x for n, x in has.items() if n not in used and n not in mapping}
    made = {name: s.factor * has[s.column] + s.offset for name, s in mapping.items()}
    offers = tuple(offer for offer in table.offers if offer.column not in used)
    held = tuple(n for n in table.held if n in left) + tuple(n for n, s in mapping.items() if s.column in table.held)
    return replace(table, columns=left | made, offers=offers, held=held)


def _from_file(path: Path) -> dict[str, str]:
    import yaml

    if not path.is_file():
        raise UserError(f"--map {path}: no such file. It is yaml with lines such as `qpos/elbow: enc deg`.")
    try:
        found = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"--map {path}: not yaml ({' '.join(str(error).split())}).") from error
    if not isinstance(found, dict) or not all(isinstance(v, str) for v in found.values()):
        raise UserError(f"--map {path}: lines such as `qpos/elbow: enc deg` are needed, {FORM} for each column.")
    return {str(k): v for k, v in found.items()}
