"""Episodes on disk: one MCAP file each, whole up to the last finished step even if the process is killed.

| topic         | one message per | fields                                                                            |
|---------------|-----------------|-----------------------------------------------------------------------------------|
| `/metadata`   | episode         | what is known before the first step: task, joint_names, seed, control_dt …        |
| `/transition` | control step    | TRANSITION_KEYS and whatever else the caller passes, such as `next_observation`   |
| `/joints`     | control step    | S samples inside the step: time [S], qpos [S,nq], qvel [S,nv], ctrl, force [S,nu] |
| `/outcome`    | episode         | what close() was given                                                            |
| `/keys`       | key             | key, a word of session/operator.py; time [s]; unix [s]                            |
| `/guided`     | control period  | S samples while a person moves the arm: time, qpos, qvel, force, object [S,3] m   |

Messages are JSON, so Foxglove, `mcap cat` and ten lines of any language can read them. The messages of one step share
one compressed chunk with a checksum: a step is in the file completely or not at all. Times are seconds since the
episode's start.
A number that is not finite is written as null (JSON has no NaN) and read back as nan. Float32 survives the round trip
exactly. The gap between simulation and reality is what `diagnose` has to find, so metadata that names it is refused.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, Self

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, DataEnd, Footer, Message, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from zstandard import ZstdError

TRANSITION_KEYS = (
    "step",
    "time",
    "observation",
    "action",
    "action_sent",
    "reward",
    "terminated",
    "truncated",
    "success",
)
JOINT_KEYS = ("time", "qpos", "qvel", "ctrl", "force")
HIDDEN_KEYS = ("gap", "effects")
TOPICS = ("/metadata", "/transition", "/joints", "/outcome", "/keys", "/guided")
STEP_TOPICS = ("/transition", "/joints")
DAMAGE = (McapError, CRCValidationError, UnicodeDecodeError, ZstdError, MemoryError, OverflowError)  # lengths, too


class Episode(NamedTuple):
    """What read_episode found.

    Attributes:
        metadata: As given to EpisodeWriter; empty if the file ends before it.
        transitions: Key -> [T, …], one row per control step.
        joints: Key -> [sum of S, …], the samples of all steps in a row; empty if none were recorded.
        outcome: As given to close(), None if the episode was never closed.
        complete: Whether the file was closed by its writer and is whole.
        lost: None if complete, otherwise what is missing, in words.
        keys: What a person pressed, in order.
        guided: Key -> [sum of S, …], samples of a person moving the arm; empty if nobody did.
    """

    metadata: dict[str, Any]
    transitions: dict[str, np.ndarray]
    joints: dict[str, np.ndarray]
    outcome: dict[str, Any] | None
    complete: bool
    lost: str | None
    keys: list[dict[str, Any]] = []
    guided: dict[str, np.ndarray] = {}


class Scan(NamedTuple):
    """What is whole in a file: (topic, time [ns], JSON) of each message, and how the file ends."""

    messages: list[tuple[str, int, bytes]]
    closed: bool
    problem: str  # empty if there is none
    unreadable: int  # bytes
    size: int  # bytes


class EpisodeWriter:
    """Writes one episode; every step is in the operating system's hands when step() returns.

    As a context manager it closes itself: with `{"aborted": …}` as the outcome if an exception ended the block, with
    an empty outcome if the block forgot to call close().

    Args:
        path: File to create; its folder must exist.
        metadata: JSON-able facts about the episode. Suggested: task, joint_names, actuator_names, seed, control_dt [s].

    Raises:
        FileExistsError: If the file is there: an episode that happened is not overwritten.
        ValueError: If metadata names the gap.
        OSError: With the path, if the file cannot be written (no permission, disk full, …), here or in any method.
    """

    def __init__(self, path: str | Path, metadata: Mapping[str, Any]) -> None:
        hidden = [key for key in HIDDEN_KEYS if key in metadata]
        if hidden:
            raise ValueError(f"Episode metadata may not contain {hidden}: diagnose must find the gap by itself.")
        text = _dumps(metadata)
        self.path = Path(path)
        self.steps = 0
        self._time = 0  # [ns] since the episode's start
        self._keys: set[str] = set()
        self._file: BinaryIO | None = self.path.open("xb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)  # each step by itself: damage stays local
        try:
            self._writer.start(profile="", library="mpc_sgft")
            self._channels = {topic: self._register(topic) for topic in TOPICS}
        except OSError as error:
            raise self._failed(error) from error
        self._write({"/metadata": text})

    def step(self, transition: Mapping[str, Any], joints: Mapping[str, Any] | None = None) -> None:
        """Append one control step and flush it.

        Args:
            transition: TRANSITION_KEYS -> number or array; more keys are welcome, the same ones in every step. `step`
                counts from 0: by it a step that is missing in the file is noticed.
            joints: `time` [S] in seconds and any of JOINT_KEYS, each [S, …]; None if the backend has no such samples.

        Raises:
            ValueError: If a key is missing, `step` is not the next one, lengths differ, or the episode is closed.
            OSError: If the step could not be written; the episode then ends with the step before.
        """
        missing = [key for key in TRANSITION_KEYS if key not in transition]
        if missing:
            raise ValueError(f"Transition {self.steps} lacks {missing}; an episode needs {list(TRANSITION_KEYS)}.")
        self._keys = self._keys or set(transition)
        if set(transition) != self._keys:
            changed = sorted(self._keys ^ set(transition))
            raise ValueError(f"Transition {self.steps} differs from the first one in {changed}: keep the same keys.")
        arrays = {key: np.asarray(value) for key, value in transition.items()}
        if arrays["step"].item() != self.steps:
            raise ValueError(
                f"Transition {self.steps} has step={arrays['step'].item()}; steps count from 0 without gaps."
            )
        self._time = round(float(arrays["time"].item()) * 1e9)
        messages = {"/transition": _dumps({key: array.tolist() for key, array in arrays.items()}, arrays)}
        if joints is not None:
            samples = {key: np.asarray(value) for key, value in joints.items()}
            lengths = {key: len(array) for key, array in samples.items()}
            if "time" not in samples or len(set(lengths.values())) != 1:
                raise ValueError(f"Joint samples need `time` and the same number of rows everywhere; got {lengths}.")
            messages["/joints"] = _dumps({key: array.tolist() for key, array in samples.items()}, samples)
        self._write(messages)
        self.steps += 1

    def key(self, word: str, *, time: float, unix: float) -> None:
        """Append a key that a person pressed: when since the episode's start, and by the computer's clock, [s]."""
        pressed = max(self._time, round(time * 1e9))
        self._write({"/keys": _dumps({"key": word, "time": time, "unix": unix})}, time=pressed)

    def guided(self, samples: Mapping[str, Any]) -> None:
        """Append what was measured while a person moved the arm, each [S, …], `time` [s] among it."""
        arrays = {key: np.asarray(value) for key, value in samples.items()}
        self._time = max(self._time, round(float(arrays["time"].max(initial=0.0)) * 1e9))
        self._write({"/guided": _dumps({key: array.tolist() for key, array in arrays.items()}, arrays)})

    def copy(self, topic: str, time: int, data: bytes) -> None:
        """Append a message of another episode as it is."""
        self._time = time  # [ns]
        self._write({topic: data.decode()}, step=self.steps - (topic == "/joints"))  # which follow their transition
        self.steps += topic == "/transition"

    def close(self, outcome: Mapping[str, Any]) -> None:
        """Write the outcome (success, return, reason it ended, …) and the file's index, then close it."""
        self._write({"/outcome": _dumps(outcome)})
        assert self._file is not None
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            raise self._failed(error) from error
        self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._file is not None:
            self.close({} if error is None else {"aborted": f"{type(error).__name__}: {error}"})

    def _register(self, topic: str) -> int:
        schema: dict[str, Any] = {"type": "object", "title": topic.strip("/")}
        if topic == "/transition":
            schema["required"] = list(TRANSITION_KEYS)
        data = json.dumps(schema).encode()
        schema_id = self._writer.register_schema(f"mpc_sgft.{topic.strip('/')}", SchemaEncoding.JSONSchema, data)
        return self._writer.register_channel(topic, MessageEncoding.JSON, schema_id)

    def _write(self, messages: Mapping[str, str], *, time: int | None = None, step: int | None = None) -> None:
        """Append messages of one time [ns] and flush them; None: of the time that was reached, and the next step."""
        time, step = self._time if time is None else time, self.steps if step is None else step
        if self._file is None:
            raise ValueError(f"The episode {self.path} is closed: nothing can be added to it.")
        try:
            for topic, text in messages.items():
                channel = self._channels[topic]
                self._writer.add_message(channel, time, text.encode(), time, sequence=step)
            self._writer.flush()
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> OSError:
        """Give up the file without another flush, and say which file and how far it got."""
        if self._file is not None:
            self._file.raw.close()  # pyright: ignore[reportAttributeAccessIssue]  # what is still buffered has no place to go
            self._file = None
        message = f"{error.strerror or error} ({self.steps} steps of the episode are kept)"
        return OSError(error.errno, message, str(self.path))


def read_episode(path: str | Path) -> Episode:
    """Read an episode, also one whose writer was killed or whose file was cut.

    Returns:
        Everything up to the last whole step, or the first one that is missing; see Episode.

    Raises:
        ValueError: If the file is not an MCAP episode at all.
        OSError: If it cannot be opened.
    """
    found, problem = scan(path), ""
    messages: dict[str, list[dict[str, Any]]] = {topic: [] for topic in TOPICS}
    for topic, _, data in found.messages:
        row, steps = json.loads(data), len(messages["/transition"])
        if topic == "/transition" and row["step"] not in (steps, [steps]):
            problem = f"step {steps} is missing"
        if not problem or topic not in STEP_TOPICS:
            messages[topic].append(row)
    steps, problem = len(messages["/transition"]), problem or found.problem
    complete = found.closed and not problem and bool(messages["/outcome"])
    lost = f"{problem}: {steps} whole steps kept, the last {found.unreadable} of {found.size} bytes unreadable"
    return Episode(
        metadata=messages["/metadata"][0] if messages["/metadata"] else {},
        transitions=_stack([{k: [v] for k, v in row.items()} for row in messages["/transition"]]),
        joints=_stack(messages["/joints"]),
        outcome=messages["/outcome"][0] if messages["/outcome"] else None,
        complete=complete,
        lost=None if complete else lost,
        keys=messages["/keys"],
        guided=_stack(messages["/guided"]),
    )


def scan(path: str | Path) -> Scan:
    """The whole messages of a file, and how it ends. One that lacks messages which its index counts has a problem.

    Raises:
        ValueError: If the file is not an MCAP episode at all.
        OSError: If it cannot be opened.
    """
    path = Path(path)
    size = path.stat().st_size
    topics: dict[int, str] = {}
    messages: list[tuple[str, int, bytes]] = []
    whole, closed, problem, seen, counted = 0, False, "", 0, None
    with path.open("rb") as file:
        head = file.read(len(MCAP0_MAGIC))
        file.seek(0)
        if not MCAP0_MAGIC.startswith(head):
            raise ValueError(f"{path} is not an MCAP file: it starts with {head!r}.")
        source, index = _WholeReads(file, size), False
        try:
            for record in StreamReader(source, validate_crcs=True, record_size_limit=size).records:  # pyright: ignore
                whole = file.tell()
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message) and not index:
                    seen += 1
                    if topics.get(record.channel_id) in TOPICS:
                        messages.append((topics[record.channel_id], record.log_time, record.data))
                elif isinstance(record, Statistics):
                    counted = record.message_count
                index, closed = index or isinstance(record, DataEnd), isinstance(record, Footer)
            if seen != counted:
                problem = f"it is damaged (its index does not count the {seen} messages that are whole)"
        except EndOfFile:
            problem = "it was never closed" if whole == size else "it ends in the middle of a record"
        except DAMAGE as error:
            problem = f"it is damaged ({str(error) or type(error).__name__})"
    if (topics or closed) and not set(TOPICS) & set(topics.values()):
        raise ValueError(f"{path} is an MCAP file without the topics {list(TOPICS)}: not an episode of this project.")
    return Scan(messages, closed, problem, size - whole, size)


class _WholeReads:
    """A binary file whose short reads are the end of the file, which is what mcap's parser expects of its source."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def read(self, length: int) -> bytes:
        data = self._file.read(length) if length <= self._size else b""  # no room is made for a damaged length
        if len(data) < length:
            raise EndOfFile()
        return data


def _stack(rows: list[dict[str, list[Any]]]) -> dict[str, np.ndarray]:
    """Concatenate lists of samples by key; null becomes nan. Keys that not every row has are an error of the writer."""
    if not rows:
        return {}
    stacked = {}
    for key in rows[0]:
        array = np.array([sample for row in rows for sample in row[key]])
        stacked[key] = array.astype(float) if array.dtype == object else array
    return stacked


def _dumps(value: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> str:
    """JSON text; walks through the values to replace what is not finite only if there is something to replace."""
    floats = [a for a in (arrays or {}).values() if a.dtype.kind == "f"]
    if arrays is None or not all(np.isfinite(a).all() for a in floats):
        value = _finite(value)
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _finite(value: Any) -> Any:
    """The same JSON value with None where a number is not finite, and plain Python where it was numpy."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
