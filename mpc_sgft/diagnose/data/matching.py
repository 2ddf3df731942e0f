"""From the names of a recording to those of a model, where they leave no choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import NamedTuple

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.mapping import Source, mapped
from mpc_sgft.diagnose.data.measured import Offer, Table


class Drive(NamedTuple):
    """What an actuator drives, None if that is no joint, and what its command asks for."""

    joint: str | None
    quantity: str


class Machine(NamedTuple):
    """The names that a recording is matched with.

    Attributes:
        joints: Of the model.
        drives: Actuator -> what it drives.
        bare: Whether the model cannot name actuators, so that recorded efforts get motors (a URDF).
    """

    joints: Sequence[str]
    drives: Mapping[str, Drive]
    bare: bool = False


def matched(table: Table, machine: Machine) -> Table:
    """The table with what it offers under the model's names; unchanged if it offers nothing.

    Raises:
        UserError: If two columns could be the same, or a column that the model needs is offered by none.
    """
    if not table.offers:
        return table
    found: dict[str, Source] = {}
    for name, fits in _wanted(table, machine).items():
        if len(fits) > 1:
            names = [offer.column for offer in fits]
            raise UserError(
                f"{table.name}: {name} may be {' or '.join(names)}. Say which: --map '{name}={names[0]}', for "
                "everything that is used of it."
            )
        if fits:
            found[name] = Source(fits[0].column, 1.0, 0.0)
    needed = [f"qpos/{j}" for j in machine.joints] + [f"ctrl/{a}" for a in machine.drives]
    missing = [name for name in needed if name not in found and name not in table.columns]
    if missing:
        raise UserError(_hint(table, machine, missing))
    if not found:
        return table
    words = ", ".join(f"{name} is {source.column}" for name, source in found.items())
    note = f"by their names, in rad or m, N m or N: {words}"
    return replace(mapped(table, found), notes=(*table.notes, note))


def _wanted(table: Table, machine: Machine) -> dict[str, list[Offer]]:
    """Our columns that are not there yet -> what is offered for each."""
    offers = table.offers
    commands = [o for o in offers if o.kind == "ctrl"]
    out = {
        f"{kind}/{j}": [o for o in offers if (o.kind, o.joint) == (kind, j)]
        for kind in ("qpos", "qvel")
        for j in machine.joints
    }
    for name, drive in machine.drives.items():
        named = [o for o in commands if o.joint and o.joint in (name, drive.joint)]
        out[f"ctrl/{name}"] = [o for o in named if o.quantity in ("", drive.quantity)]
        if len(machine.drives) == 1 and len(commands) == 1 and not commands[0].joint:  # one that names none
            out[f"ctrl/{name}"] = [o for o in commands if o.quantity in ("", drive.quantity)]
    if machine.bare and commands and not any(name.startswith("ctrl/") for name in table.columns):
        out |= _efforts(table, machine, commands)
    return {name: fits for name, fits in out.items() if name not in table.columns}


def _efforts(table: Table, machine: Machine, commands: list[Offer]) -> dict[str, list[Offer]]:
    """Commands that are efforts of joints by name, for a model that names no actuators."""
    efforts = [o for o in commands if o.quantity == "effort"]
    out = {f"ctrl/{j}": fits for j in machine.joints if (fits := [o for o in efforts if o.joint == j])}
    if not out and len(machine.joints) == len(commands) == len(efforts) == 1 and not efforts[0].joint:
        out = {f"ctrl/{machine.joints[0]}": efforts}
    if not out:
        raise UserError(
            f"{table.name}: it holds commands ({', '.join(o.column for o in commands)}), none of which is by its name "
            "the effort of a joint, and a URDF knows no servos. Give an MJCF scene with the servos, or say which are "
            f"efforts: --map 'ctrl/{machine.joints[0]}={commands[0].column}'."
        )
    return out


def _hint(table: Table, machine: Machine, missing: list[str]) -> str:
    """What to write for columns that nothing was found for."""
    said = []
    for name in missing:
        kind, _, part = name.partition("/")
        asks = ("", machine.drives[part].quantity if kind == "ctrl" else "position")
        offered = {o.joint: o.column for o in table.offers if o.kind == kind and o.quantity in asks}
        near = get_close_matches(part, offered, 1, 0.5)
        said.append(f"{name}={offered[near[0]] if near else 'COLUMN'}")
    wrong = [d.quantity for a, d in machine.drives.items() if f"ctrl/{a}" in missing]
    told = {o.quantity for o in table.offers if o.kind == "ctrl"} - {""}
    else_ = (
        f"; the model's actuators take {wrong[0]}, the recording commands {' and '.join(sorted(told))}"
        if wrong and told
        else ""
    )
    return (
        f"{table.name}: nothing is called as in the model: {', '.join(missing)}. Say what they are: --map "
        f"'{','.join(said)}' (a unit may follow: deg){else_}. It has: {', '.join(o.column for o in table.offers)}."
    )
