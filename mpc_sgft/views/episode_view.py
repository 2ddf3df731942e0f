"""An episode as the rerun viewer shows it: the arrays it needs and how they become columns."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr

from mpc_sgft.views.blueprint import Layout
from mpc_sgft.views.value_image import viridis

Colour = tuple[int, int, int]
REAL_EE, REAL_OBJECT = (90, 170, 255), (110, 220, 160)
IMAGINED_EE, IMAGINED_OBJECT = (255, 170, 60), (205, 110, 255)
GHOST_ALPHA = 110
LINE, THICK, CANDIDATE_RADII = -1.0, -2.0, (-0.3, -1.3)  # negative: points of the screen, at any distance


class Candidates(NamedTuple):
    """The plans weighed at step t of an episode: end effector paths [N, H+1, 3] in metres, values [N]."""

    t: int
    paths: np.ndarray
    values: np.ndarray


class EpisodeView(NamedTuple):
    """An episode of T steps; positions in metres in the world's frame. What is None is not shown.

    Attributes:
        title: In words, for the list of episodes.
        ee: End effector, [T+1, 3].
        qpos: Of the model given to RunViewer, [T+1, nq].
        object: What is manipulated, [T+1, 3].
        imagined_ee: From each step, now and the next H steps along the plan, [T, H+1, 3].
        imagined_object: The same of the object, [T, H+1, 3].
        candidates: Of selected steps.
        reward: [T].
        predicted_return: What the planner expected at each step, [T].
        real_return: What then came, over the same horizon or to the end, as the caller prefers, [T].
        model_error: Of the imagination 1…H steps ahead, [T, H]; nan where the episode ended before.
        plan_ms: Time the planner took, [T].
        success: Whether the episode ended well.
    """

    title: str
    ee: np.ndarray
    qpos: np.ndarray | None = None
    object: np.ndarray | None = None
    imagined_ee: np.ndarray | None = None
    imagined_object: np.ndarray | None = None
    candidates: Sequence[Candidates] = ()
    reward: np.ndarray | None = None
    predicted_return: np.ndarray | None = None
    real_return: np.ndarray | None = None
    model_error: np.ndarray | None = None
    plan_ms: np.ndarray | None = None
    success: bool | None = None

    @property
    def steps(self) -> int:
        """T."""
        return len(self.ee) - 1

    def check(self) -> None:
        """Raise ValueError naming the first array whose shape does not fit the others."""
        t = self.steps
        horizon = None if self.imagined_ee is None else self.imagined_ee.shape[1]
        shapes = {"ee": (t + 1, 3), "object": (t + 1, 3), "qpos": (t + 1, None), "model_error": (t, None)}
        shapes |= dict.fromkeys(("imagined_ee", "imagined_object"), (t, horizon, 3))
        shapes |= dict.fromkeys(("reward", "predicted_return", "real_return", "plan_ms"), (t,))
        for name, expected in shapes.items():
            array = getattr(self, name)
            if array is not None and not _fits(array.shape, expected):
                raise ValueError(
                    f"EpisodeView.{name} must be {list(expected)} in an episode of {t} steps, got {array.shape}."
                )
        for c in self.candidates:
            if not 0 <= c.t < t or c.paths.ndim != 3 or c.values.shape != c.paths.shape[:1]:
                raise ValueError(
                    f"Candidates need 0 <= t < {t}, paths [N, H+1, 3] and values [N]; "
                    f"got t={c.t}, {c.paths.shape} and {c.values.shape}."
                )


class Rows(NamedTuple):
    """Where an episode lies on the timelines."""

    recording: rr.RecordingStream
    first_step: int
    episode: int

    def indexes(self, count: int, start: int = 0) -> list[rr.TimeColumn]:
        step = np.arange(count) + self.first_step + start
        return [
            rr.TimeColumn("env_step", sequence=step),
            rr.TimeColumn("episode", sequence=np.full(count, self.episode)),
        ]

    def send(self, path: str, count: int, columns: Iterable[rr.ComponentColumn], start: int = 0) -> None:
        self.recording.send_columns(path, self.indexes(count, start), columns)


def log_episode(rows: Rows, data: EpisodeView, layout: Layout) -> None:
    """Send everything of an episode but the robot's pose and the line of text."""
    _log_real(rows, data, layout)
    _log_imagined(rows, data, layout)
    for candidates in data.candidates:
        _log_candidates(rows, candidates)
    rows.send("world/candidates", 1, _strips(np.zeros((0, 2, 3)), [0], np.zeros((0, 3)), LINE), start=data.steps)
    _log_numbers(rows, data)


def log_series_styles(recording: rr.RecordingStream) -> None:
    """Names and colours of the plotted lines, once a file."""
    styles: dict[str, tuple[str, Colour]] = {
        "returns/predicted": ("predicted", IMAGINED_EE),
        "returns/real": ("real", REAL_EE),
        "reward/reward": ("reward", REAL_OBJECT),
        "planner/plan_ms": ("plan", (190, 150, 255)),
    }
    for path, (name, colour) in styles.items():
        recording.log(path, rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)


def _log_real(rows: Rows, data: EpisodeView, layout: Layout) -> None:
    for name, points, colour in (("ee", data.ee, REAL_EE), ("object", data.object, REAL_OBJECT)):
        if points is None:
            continue
        pieces = np.stack([points[:-1], points[1:]], 1)  # [T, 2, 3]
        so_far = np.concatenate([pieces[:t] for t in range(data.steps + 1)])
        lengths = np.arange(data.steps + 1)
        rows.send(
            f"world/trail/{name}",
            data.steps + 1,
            _strips(so_far, lengths, np.tile((*colour, 255), (len(so_far), 1)), LINE),
        )
    if data.object is not None and not layout.object_in_model:
        rows.send("world/object", data.steps + 1, _cylinders(data.object, layout, (*REAL_OBJECT, 255)))


def _log_imagined(rows: Rows, data: EpisodeView, layout: Layout) -> None:
    """The imagined future of each step, and one step later the ghost of what had been imagined for it."""
    steps = data.steps
    parts = (("ee", data.imagined_ee, IMAGINED_EE), ("object", data.imagined_object, IMAGINED_OBJECT))
    for name, points, colour in parts:
        if points is None:
            continue
        lengths = [1] * steps + [0]  # nothing is imagined from the last state
        rows.send(
            f"world/imagined/{name}", steps + 1, _strips(points, lengths, np.tile((*colour, 255), (steps, 1)), THICK)
        )
        ahead = points[:, 1:].reshape(-1, 3)
        horizon = points.shape[1] - 1
        dots = rr.Points3D.columns(
            positions=ahead, colors=np.tile(colour, (len(ahead), 1)), radii=np.full(len(ahead), 2 * THICK)
        )
        rows.send(f"world/imagined/{name}/steps", steps + 1, dots.partition([horizon] * steps + [0]))
        ghost = (*colour, GHOST_ALPHA)
        if name == "object":
            columns = _cylinders(points[:, 1], layout, ghost)
        else:
            columns = rr.Ellipsoids3D.columns(
                centers=points[:, 1],
                half_sizes=np.full((steps, 3), layout.ee_radius),
                colors=np.tile(ghost, (steps, 1)),
                fill_mode=[rr.components.FillMode.Solid] * steps,
            )
        rows.send(f"world/ghost/{name}", steps, columns, start=1)
        rows.recording.set_time("env_step", sequence=rows.first_step)
        rows.recording.set_time("episode", sequence=rows.episode)
        rows.recording.log(f"world/ghost/{name}", rr.Clear(recursive=False))
        rows.recording.reset_time()


def _log_candidates(rows: Rows, candidates: Candidates) -> None:
    """All plans of one step, best last so that it is drawn on top; the next step shows none."""
    order = np.argsort(candidates.values)
    low, high = np.percentile(candidates.values, [5, 100])
    colours = viridis((candidates.values[order] - low) / max(high - low, 1e-9))  # [N, 3]
    paths = candidates.paths[order]
    columns = _strips(paths, [len(paths), 0], colours, np.linspace(*CANDIDATE_RADII, len(order)))
    rows.send("world/candidates", 2, columns, start=candidates.t)


def _log_numbers(rows: Rows, data: EpisodeView) -> None:
    series = {
        "returns/predicted": data.predicted_return,
        "returns/real": data.real_return,
        "reward/reward": data.reward,
        "planner/plan_ms": data.plan_ms,
    }
    if data.model_error is not None:
        horizon = data.model_error.shape[1]
        shades = viridis(np.linspace(1.0, 0.2, horizon))
        for h in range(horizon):
            path = f"model_error/h{h + 1}"
            rows.recording.log(path, rr.SeriesLines(names=f"h{h + 1}", colors=shades[h], widths=1.5), static=True)
            series[path] = data.model_error[:, h]
    for path, values in series.items():
        if values is not None:
            broken = np.append(np.asarray(values, dtype=float), np.nan)  # no line from one episode to the next
            rows.send(path, len(broken), rr.Scalars.columns(scalars=broken))


def _strips(
    strips: np.ndarray, lengths: Sequence[int] | np.ndarray, colours: np.ndarray, radius: float | np.ndarray
) -> rr.ComponentColumnList:
    """Columns of line strips [M, P, 3], lengths[row] of them in each row; they must stay one array, lists are slow."""
    return rr.LineStrips3D.columns(
        strips=np.asarray(strips, dtype=np.float32),
        colors=colours.astype(np.uint8),
        radii=np.broadcast_to(radius, len(strips)),
    ).partition(lengths)


def _cylinders(centres: np.ndarray, layout: Layout, colour: tuple[int, int, int, int]) -> rr.ComponentColumnList:
    count = len(centres)
    return rr.Cylinders3D.columns(
        centers=centres,
        lengths=np.full(count, layout.object_height),
        radii=np.full(count, layout.object_radius),
        colors=np.tile(colour, (count, 1)),
        fill_mode=[rr.components.FillMode.Solid] * count,
    )


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(e is None or s == e for s, e in zip(shape, expected, strict=True))
