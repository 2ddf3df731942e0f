"""A value over a plane as a picture with axes, a colour bar and marks, for the rerun viewer."""

from collections.abc import Mapping

import numpy as np
import rerun as rr

CANVAS = (520, 340)  # [pixel] width and height of every picture, so that a view can be set up before there is one
MAP = (95, 10, 315, 285)  # [pixel] left, top, width and height of the room for the map
BAR = (430, 14)  # [pixel] left and width of the colour bar
STOPS = np.array(
    [
        (68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142),
        (31, 158, 137), (53, 183, 121), (109, 205, 89), (180, 222, 44), (253, 231, 37),
    ]
)  # fmt: skip
BACKGROUND = (22, 25, 31)
TEXT, MARK = (185, 190, 200), (255, 255, 255)


def viridis(share: np.ndarray) -> np.ndarray:
    """Colours [..., 3] 0…255 of shares [...], clipped to 0…1: dark violet to yellow, even in lightness."""
    at = np.clip(share, 0, 1) * (len(STOPS) - 1)
    return np.stack([np.interp(at, np.arange(len(STOPS)), STOPS[:, k]) for k in range(3)], -1).round().astype(np.uint8)


def log_value_map(
    recording: rr.RecordingStream,
    path: str,
    values: np.ndarray,
    extent: tuple[float, float, float, float],
    marks: Mapping[str, tuple[float, float]],
    limits: tuple[float, float] | None,
    axes: tuple[tuple[str, str], tuple[str, str]] = (("x", "m"), ("y", "m")),
) -> None:
    """Log the picture statically at `path`; the first axis right, the second up. Arguments as RunViewer.value_map's.

    Raises:
        ValueError: If values is not a finite matrix, or the extent or the limits are not increasing.
    """
    values = np.asarray(values, dtype=float)
    if values.ndim != 2 or not np.isfinite(values).all():
        raise ValueError(f"A value map must be a finite matrix, got shape {values.shape} with nan or infinity.")
    x0, x1, y0, y1 = extent
    low, high = (values.min(), values.max()) if limits is None else limits
    if not (x0 < x1 and y0 < y1 and low <= high):
        raise ValueError(f"Need x0 < x1, y0 < y1 and low <= high, got extent {extent} and limits {(low, high)}.")
    left, top, room_x, room_y = MAP
    (x_name, x_unit), (y_name, y_unit) = axes
    scale_x, scale_y = room_x / (x1 - x0), room_y / (y1 - y0)
    if x_unit == y_unit:
        scale_x = scale_y = min(scale_x, scale_y)
    width, height = round((x1 - x0) * scale_x), round((y1 - y0) * scale_y)
    left += (room_x - width) // 2
    share = (_smooth(values, width, height) - low) / max(high - low, 1e-12)
    picture = np.full((CANVAS[1], CANVAS[0], 3), BACKGROUND, dtype=np.uint8)
    picture[top : top + height, left : left + width] = viridis(share)
    picture[top : top + height, BAR[0] : sum(BAR)] = viridis(np.linspace(1, 0, height))[:, None]
    recording.log(path, rr.Image(picture), static=True)
    below, right = top + height + 20, sum(BAR) + 34
    texts = {
        (left + 24, below): f"{x_name} {x0:.2f} {x_unit}", (left + width - 24, below): f"{x1:.2f} {x_unit}",
        (left - 44, top + height - 14): f"{y0:.2f} {y_unit}", (left - 44, top + 14): f"{y_name} {y1:.2f} {y_unit}",
        (right, top + 14): f"{high:.3g}", (right, top + height - 14): f"{low:.3g}",
    }  # fmt: skip
    recording.log(
        f"{path}/axes", rr.Points2D(list(texts), radii=0.01, colors=TEXT, labels=list(texts.values())), static=True
    )
    places = [(left + (x - x0) * scale_x, top + (y1 - y) * scale_y) for x, y in marks.values()]
    recording.log(f"{path}/marks", rr.Points2D(places, colors=MARK, radii=4.0, labels=list(marks)), static=True)


def _smooth(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Bilinear interpolation of [G, G'] (x, y) onto pixels [height, width], y upwards."""
    columns = np.linspace(0, values.shape[0] - 1, width)
    rows = np.linspace(values.shape[1] - 1, 0, height)
    along_x = np.stack([np.interp(columns, np.arange(values.shape[0]), values[:, j]) for j in range(values.shape[1])])
    return np.stack([np.interp(rows, np.arange(values.shape[1]), along_x[:, i]) for i in range(width)], 1)
