"""One rerun file a run: what the robot did, what the model imagined, what the planner weighed.

Nothing here is called while a robot moves: an episode is buffered by its owner and sent once, as columns.

Timelines: `env_step` counts the states shown, T + 1 for an episode of T steps, and goes on over episodes; `episode`
counts episodes. Entities:

| path                    | what                                                                                    |
|-------------------------|-----------------------------------------------------------------------------------------|
| world/robot             | the model, moved by qpos                                                                |
| world/object            | the object, where the model does not contain it                                         |
| world/trail/*           | the way of end effector and object so far in this episode                               |
| world/imagined/*        | where the model, at this step, imagines end effector and object over the next H steps   |
| world/ghost/*           | where it thought one step ago that they would be now                                    |
| world/candidates        | the planner's candidate plans of selected steps, dark (worst) to yellow (best)          |
| value_map/<name>        | a value over two quantities that the task names                                         |
| returns, model_error, … | plots                                                                                   |
| episodes                | outcomes in words                                                                       |
"""

import itertools
import math
import struct
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import mujoco
import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.whole_file import naming, write_whole
from mpc_sgft.views.blueprint import Layout, blueprint
from mpc_sgft.views.episode_view import Candidates, EpisodeView, Rows, log_episode, log_series_styles
from mpc_sgft.views.robot_view import RobotView
from mpc_sgft.views.value_image import log_value_map

__all__ = ["Candidates", "EpisodeView", "Layout", "RunViewer"]

RRD_MAGIC, RRD_HEADER = b"RRF", 12  # how a file begins; bytes before its first frame
NOT_COUNTED = "does not count: it is driven again"
AWAY = "Move it away to resume: what is drawn then goes into a new one."
NOT_DRAWN = " (not drawn: this file is bounded by log.rerun_mb)"
RRD_FRAME, RRD_FOOTER = struct.Struct("<QQ"), 0  # kind and length of a frame; the kind after the last message


class RunViewer:
    """Writes run.rrd.

    Args:
        path: File to write; its folder must exist.
        model: Drawn and moved by EpisodeView.qpos; None for a robot without a model.
        control_dt: [s] between two steps.
        layout: Camera, sizes and views.
        limit: Bytes that the file stays below; None: no bound. Every episode is drawn until it is half full, then every
            second one until half of the rest is used, every fourth, and so on. The others are a line of text.
        resume: Go on with a file that is there, which a killed run may have left unfinished.

    Raises:
        FileExistsError: If the file is there and resume is False.
        UserError: If a file to go on with is no rerun recording, or damaged; it then stays where it was.
        OSError: If the file cannot be written; also from episode(), metrics(), value_map() and close().
    """

    def __init__(
        self,
        path: str | Path,
        model: mujoco.MjModel | None,
        *,
        control_dt: float,
        layout: Layout = Layout(),  # noqa: B008  # immutable
        limit: int | None = None,
        resume: bool = False,
    ) -> None:
        self.path, self._limit = Path(path), limit
        self._model, self._layout = model, layout
        self._step, self._episode = 0, 0
        self.earlier: set[str] = set()  # titles of the episodes that a resumed file held
        aside = self.path.with_suffix(".earlier.rrd")
        chunks = _set_aside(self.path, aside) if resume else []
        # Rerun's own file sink may wait forever on a full disk, so the bytes are taken from memory and written here.
        self._file = self.path.open("xb", buffering=0)
        self._blueprint = blueprint(model, layout, control_dt)
        self._start()
        self._robot = RobotView(self._recording, model, "world/robot") if model is not None else None
        if chunks:
            self._take_over(chunks)
        else:
            self._log_static()
        self._flush()
        aside.unlink(missing_ok=True)

    @property
    def env_step(self) -> int:
        """Where the next episode starts on the timeline `env_step`."""
        return self._step

    def episode(self, data: EpisodeView) -> None:
        """Add one episode.

        Raises:
            ValueError: If an array has another shape than EpisodeView says, or qpos comes without a model.
        """
        data.check()
        if data.qpos is not None and self._robot is None:
            raise ValueError("qpos given, but RunViewer has no model to move with it.")
        rows, last = Rows(self._recording, self._step, self._episode), self._step + data.steps
        drawn = self._episode % self._every() == 0
        if drawn and self._robot is not None and data.qpos is not None:
            self._robot.log_poses(rows.indexes(data.steps + 1), data.qpos)
        if drawn:
            log_episode(rows, data, self._layout)
        self._at(last)
        outcome = {True: "success", False: "no success", None: "ended"}[data.success]
        total = "" if data.reward is None else f", return {float(np.sum(data.reward)):.2f}"
        text = f"{self._episode}: {outcome}, {data.steps} steps{total}. {data.title}"
        text += "" if drawn else NOT_DRAWN
        level = rr.TextLogLevel.WARN if data.success is False else rr.TextLogLevel.INFO
        self._recording.log("episodes", rr.TextLog(text, level=level))
        if data.success is not None:
            self._recording.log("success", rr.Scalars(float(data.success)))
        self._step, self._episode = last + 1, self._episode + 1
        self._flush()

    def correct(self, success: bool | None) -> None:
        """Say of the last episode what it counts as after all: it reached its goal, or not; None: it does not count."""
        number = self._episode - 1
        counts = {True: "counts as a success", False: "counts as no success", None: NOT_COUNTED}[success]
        self._recording.set_time("env_step", sequence=self._step - 1)
        self._recording.set_time("episode", sequence=number)
        self._recording.log("episodes", rr.TextLog(f"{number} {counts}", level=rr.TextLogLevel.INFO))
        self._recording.log("success", rr.Scalars(math.nan if success is None else float(success)))
        self._flush()

    def _every(self) -> int:
        """One of how many episodes is drawn now."""
        free = 1.0 if self._limit is None else 1 - self.path.stat().st_size / self._limit
        return 2 ** int(-math.log2(free)) if free > 2**-20 else 2**20

    def metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Add scalars at `metrics/<name>`, at a position on the timeline `env_step` (RunViewer.env_step is now)."""
        self._at(step)
        for name, value in values.items():
            self._recording.log(f"metrics/{name}", rr.Scalars(float(value)))
        self._flush()

    def value_map(
        self,
        name: str,
        values: np.ndarray,
        extent: tuple[float, float, float, float],
        *,
        marks: Mapping[str, tuple[float, float]] | None = None,
        limits: tuple[float, float] | None = None,
        axes: tuple[tuple[str, str], tuple[str, str]] = (("x", "m"), ("y", "m")),
    ) -> None:
        """Show a value over two quantities; a later map of the same name replaces it.

        Args:
            name: One of Layout.value_maps.
            values: [G, G'], first index along x, second along y.
            extent: x from, x to, y from, y to, in the units of the axes.
            marks: Named places to mark, such as where the object is.
            limits: Values of the first and last colour, to compare maps; None: from this map.
            axes: Name and unit of x and y; of one unit, both have one scale.

        Raises:
            ValueError: If the blueprint has no view of that name, or values is not a finite matrix.
        """
        if name not in self._layout.value_maps:
            raise ValueError(f"No view for the value map {name!r}. The layout has {list(self._layout.value_maps)}.")
        log_value_map(self._recording, f"value_map/{name}", values, extent, marks or {}, limits, axes)
        self._flush()

    def close(self) -> None:
        """Finish the file with its index; the viewer cannot be used afterwards."""
        self._flush()
        self._file.close()
        self._recording.disconnect()
        chunks = _chunks(self.path)
        self._start()
        self._recording.send_chunks(chunks)
        write_whole(self.path, self._stream.read() or b"")
        self._recording.disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        """A recording in memory, which begins with the blueprint."""
        self._recording = rr.RecordingStream("mpc_sgft")
        self._recording.set_log_time_enabled(False)
        self._stream = self._recording.binary_stream()
        self._recording.send_blueprint(self._blueprint, make_active=False, make_default=True)

    def _at(self, step: int) -> None:
        self._recording.set_time("env_step", sequence=step)
        self._recording.set_time("episode", sequence=self._episode)

    def _log_static(self) -> None:
        self._recording.send_recording_name("/".join(self.path.resolve().parts[-3:-1]))
        self._recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log_series_styles(self._recording)
        self._at(0)
        if self._robot is not None:
            self._robot.log_shapes()

    def _take_over(self, chunks: list[Chunk]) -> None:
        """Send what an earlier file held and go on counting where it stopped."""
        self._recording.send_chunks(chunks)
        titles, lines = dict[str, str](), list[str]()
        for chunk in chunks:
            if chunk.entity_path == "/episodes":
                batch = chunk.to_record_batch()
                self._step = max(self._step, *(row + 1 for row in batch.column("env_step").to_pylist()))
                self._episode = max(self._episode, *(row + 1 for row in batch.column("episode").to_pylist()))
                lines += itertools.chain(*batch.column("TextLog:text").to_pylist())
        for text in lines:
            number, shown, rest = text.partition(": ")
            if shown and number.isdecimal():
                titles[number] = rest.partition(". ")[2].removesuffix(NOT_DRAWN)
        taken_back = {text.removesuffix(f" {NOT_COUNTED}") for text in lines if text.endswith(NOT_COUNTED)}
        self.earlier = {title for number, title in titles.items() if number not in taken_back}

    def _flush(self) -> None:
        """Put everything so far into the file."""
        self._recording.reset_time()
        new = self._stream.read() or b""  # a whole file: header, messages, footer
        data = new[0 if self._file.tell() == 0 else RRD_HEADER : _end_of_messages(new)]
        with naming(self.path):
            while data:
                data = data[self._file.write(data) :]


def _end_of_messages(data: bytes) -> int:
    """Where the last whole message of a rerun file ends: before its footer, or before a half-written message."""
    at = RRD_HEADER
    while at + RRD_FRAME.size <= len(data):
        kind, length = RRD_FRAME.unpack_from(data, at)
        if kind == RRD_FOOTER or at + RRD_FRAME.size + length > len(data):
            break
        at += RRD_FRAME.size + length
    return at


def _set_aside(path: Path, aside: Path) -> list[Chunk]:
    """Move the file of a resumed run to `aside` and return what it holds.

    Raises:
        UserError: If it is no rerun recording, or damaged; it then stays where it was.
    """
    source = aside if aside.exists() else path  # aside is there if an earlier take-over was killed: it holds more
    if not source.exists():
        return []
    chunks = _chunks(source)
    if source == path:
        path.rename(aside)
    else:
        path.unlink(missing_ok=True)
    return chunks


def _chunks(path: Path) -> list[Chunk]:
    """What a file holds, without a half-written message at its end.

    Raises:
        UserError: If it is no rerun recording, or damaged.
    """
    data = path.read_bytes()
    if data[: len(RRD_MAGIC)] != RRD_MAGIC[: len(data)]:
        raise UserError(f"{path} is no rerun recording: it starts with {data[:4]!r}. {AWAY}")
    whole = _end_of_messages(data)
    if not any(data[whole : whole + RRD_FRAME.size]) and any(data[whole:]):  # no footer
        raise UserError(f"{path} is damaged: only zeros at byte {whole}, and more after them. {AWAY}")
    if whole <= RRD_HEADER:
        return []
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*no footer.*")  # only `close` writes one
        readable = Path(folder) / path.name
        with naming(readable):
            readable.write_bytes(data[:whole])
        try:
            return RrdReader(readable).stream().to_chunks()
        except RuntimeError as error:
            said = str(error).replace(str(readable), path.name).partition("\n")[0]
            raise UserError(f"{path} is damaged ({said}). {AWAY}") from error
