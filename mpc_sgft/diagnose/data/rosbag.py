"""ROS 2 bags: a folder with metadata.yaml, or one .mcap or .db3 file. The clock is that of a JointState topic.

Commands are held until the next one, and taken up at the next sample of that clock. Times of a topic are those of the
headers where all its messages have one, else those at which they were recorded; the latter for all if clocks are apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Array, Offer, Table
from mpc_sgft.diagnose.data.ros_messages import READ, STATE, Stream, says_command, take

NEEDS = "ROS 2 bags need the package rosbags: pip install 'mpc_sgft[ros]'."
APART = 1e9  # [ns] by which clocks may differ, and still be one
MAGIC = b"\x89MCAP0\r\n"


class Bag(NamedTuple):
    """What was read: streams of numbers, and (topic, type, messages, why not) of what was not."""

    path: Path
    streams: list[Stream]
    left: list[tuple[str, str, int, str]]


def is_bag(path: Path) -> bool:
    """Whether this is a recording of ROS 2; an .mcap file says so in its first record."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix.lower() == ".mcap" and path.is_file():
        with path.open("rb") as file:
            head = file.read(64)
        return head.startswith(MAGIC) and head[len(MAGIC) : len(MAGIC) + 1] == b"\x01" and b"ros2" in head[:40]
    return path.suffix.lower() == ".db3" and path.is_file()


def read_bag(path: Path) -> Bag:
    """All messages of the types in `ros_messages`.

    Raises:
        UserError: If rosbags is not installed, the bag cannot be read, or it is empty.
    """
    streams: dict[tuple[str, tuple], Stream] = {}
    left: list[tuple[str, str, int, str]] = []
    for topic, kind, message, log in _messages(path, left):
        take(streams, topic, kind, message, log)
    if not streams:
        there = ", ".join(f"{topic} ({kind})" for topic, kind, *_ in left) or "nothing"
        raise UserError(
            f"{path}: no message of joints or commands in it. It holds {there}; {', '.join(READ)} are read."
        )
    return Bag(path, list(streams.values()), left)


def _messages(path: Path, left: list[tuple[str, str, int, str]]) -> Iterator[tuple[str, str, Any, int]]:
    """(topic, type, message, when it was recorded [ns]) of each that can be used; the others' topics go to `left`."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise UserError(f"{path}: {NEEDS}") from error

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            known = [c for c in reader.connections if c.msgtype in READ and c.msgtype in reader.typestore.fielddefs]
            for c in reader.connections:
                if c not in known:
                    why = "the bag does not define this type" if c.msgtype in READ else "not used"
                    left.append((c.topic, c.msgtype, c.msgcount, why))
            for connection, log, raw in reader.messages(known) if known else ():
                yield connection.topic, connection.msgtype, reader.deserialize(raw, connection.msgtype), log
    except Exception as error:  # rosbags lets out whatever its unpackers and databases make of damaged bytes
        said = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{path}: cannot be read as a ROS 2 bag ({said}). `ros2 bag reindex` may mend it.") from error


def describe_bag(bag: Bag) -> str:
    """Topics, in lines: how many messages, how often, of what."""
    lines = [f"{bag.path}: ROS 2 bag"]
    for s in bag.streams:
        time = s.clock(False)
        rate = f"{1e9 * (len(time) - 1) / max(np.ptp(time), 1):.4g} Hz, " if len(time) > 1 else ""
        role, clock = "commands" if s.commands else "state", "header" if s.stamped else "recorder"
        lines.append(f"  {s.topic}: {s.kind}, {len(time)} messages, {rate}{role}, clock of the {clock}, {_names(s)}")
    lines += [f"  {topic}: {kind}, {count} messages, {why}" for topic, kind, count, why in bag.left]
    return "\n".join(lines)


def table_of(bag: Bag, used: Iterable[str] = (), joints: Sequence[str] = ()) -> Table:
    """The bag on one clock, under its own names.

    Args:
        bag: What was read.
        used: Columns that a mapping takes positions from: they say which topic is the clock.
        joints: Of the model, which may say it, too.

    Raises:
        UserError: If it is not clear whose clock to take.
    """
    by_log, notes = _which_time(bag)
    clock = _clock(bag, set(used), joints)
    time = np.sort(clock.clock(by_log))
    order = np.argsort(clock.clock(by_log), kind="stable")
    rows = np.array([clock.rows[k] for k in order], float)
    columns: dict[str, Array] = {"time": 1e-9 * (time - time[0]).astype(float)}
    columns |= {name: rows[:, i] for i, name in enumerate(clock.columns())}
    held: list[str] = []
    for stream in bag.streams:
        if stream is clock or not (stream.commands or set(used) & set(stream.columns())):
            continue
        more = stream.held(time, by_log) if stream.commands else stream.between(time, by_log)
        if twice := sorted(set(more) & set(columns)):
            raise UserError(
                f"{bag.path}: {twice[0]} comes in messages that speak of different joints; record them apart."
            )
        columns |= more
        held += more
        notes.append(_how(stream, clock, time, by_log))
    notes.append(f"the clock is that of {clock.topic}")
    name = bag.path.resolve().name if bag.path.is_dir() else bag.path.stem
    return Table(name, columns, notes=tuple(notes), offers=tuple(_offers(bag, clock, columns)), held=tuple(held))


def _which_time(bag: Bag) -> tuple[bool, list[str]]:
    """Whether the recorder's clock is needed because the topics' own clocks are apart, and what to say of it."""
    late = [
        float(np.median(s.clock(True) - s.clock(False))) for s in bag.streams
    ]  # [ns] from its own to the recorder's
    first, last = (bag.streams[i].topic for i in (int(np.argmin(late)), int(np.argmax(late))))
    if max(late) - min(late) <= APART:
        return False, []
    return True, [
        f"{first} and {last} are {1e-9 * (max(late) - min(late)):.3g} s apart by their own clocks (headers where all "
        "messages have one, else the recorder's): all times are those of the recorder"
    ]


def _clock(bag: Bag, used: set[str], joints: Sequence[str]) -> Stream:
    states = [s for s in bag.streams if not s.commands]
    chosen = [s for s in bag.streams if s.kind == STATE and used & set(s.columns())]
    if chosen:
        return max(chosen, key=lambda s: len(s.logs))
    if not states:
        raise UserError(f"{bag.path}: no {STATE} topic that is no command. {_listing(bag)}")
    if len(states) > 1:
        whole = [s for s in states if joints and {(j, "position") for j in joints} <= set(s.keys)]
        if len(whole) != 1:
            example = next((s.column(k) for s in states for k in s.keys if k[1] == "position"), "COLUMN")
            joint = joints[0] if joints else "JOINT"
            raise UserError(
                f"{bag.path}: {len(states)} topics of measured joints. {_listing(bag)} Say which are meant: --map "
                f"'qpos/{joint}={example}', for each joint and command."
            )
        return whole[0]
    return states[0]


def _how(stream: Stream, clock: Stream, time: np.ndarray, by_log: bool) -> str:
    if not stream.commands:
        return f"{stream.topic} is read on straight lines between its messages, at the times of {clock.topic}"
    came = np.sort(stream.clock(by_log))
    next_sample = np.searchsorted(time, came)
    inside = next_sample < len(time)
    wait = float(np.median(time[next_sample[inside]] - came[inside])) if inside.any() else 0.0
    source = "their headers" if stream.stamped and not by_log else "the recorder"
    return f"commands of {stream.topic}, by the clock of {source}, are taken up {1e-6 * wait:.3g} ms after they came"


def _offers(bag: Bag, clock: Stream, columns: dict[str, Array]) -> list[Offer]:
    out = []
    for (joint, quantity), name in zip(clock.keys, clock.columns(), strict=True):
        if quantity == "position" or (quantity == "velocity" and np.isfinite(columns[name]).all()):
            out.append(Offer(name, "qpos" if quantity == "position" else "qvel", joint, quantity))
    commands = [s for s in bag.streams if s is not clock and s.commands]
    commands = [s for s in commands if says_command(s.topic) or _named(s)] or commands
    for stream in commands:
        for name, key in stream.columns().items():
            out.append(Offer(name, "ctrl", key[0] if _named(stream) else "", stream.quantity(key)))
    return out


def _named(stream: Stream) -> bool:
    return not all(joint.isdigit() for joint, _ in stream.keys)


def _names(s: Stream) -> str:
    return ", ".join(name.removeprefix(f"{s.topic}/") for name in s.columns())


def _listing(bag: Bag) -> str:
    topics: list[Any] = [f"{s.topic} ({s.kind}: {_names(s)})" for s in bag.streams]
    topics += [f"{topic} ({kind})" for topic, kind, *_ in bag.left]
    return f"It holds {'; '.join(topics)}."
