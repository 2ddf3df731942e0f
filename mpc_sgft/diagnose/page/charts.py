"""Charts as plain SVG that follows the page: colours are classes, text is the page's own, and lines keep their width.

Made by hand and not with a plotting library: light and dark, and zooming without a script of megabytes, want elements
that CSS reaches.
"""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

from mpc_sgft.diagnose.data.measured import Array

LEFT, RIGHT, TOP, BOTTOM = 62, 12, 10, 38  # margins of the plot
FEW = 200  # dots


class Chart:
    """Axes with lines, dots and bars in them.

    Args:
        width, height: Of the drawing; the page scales it.
        x, y: Ranges.
        labels: Of the x and the y axis, with units.
        log_x: Whether x is logarithmic.
        left, right: Margins beside the plot.
        zoom: Whether dragging across it shows that part.
    """

    def __init__(
        self,
        width: int,
        height: int,
        x: tuple[float, float],
        y: tuple[float, float],
        labels: tuple[str, str],
        *,
        log_x: bool = False,
        left: int = LEFT,
        right: int = RIGHT,
        zoom: bool = False,
    ):
        self.width, self.height, self.log_x, self.zoom = width, height, log_x, zoom
        self.left, self.right = left, width - right
        self.x, self.y, self.labels = _widened(x), _widened(y), labels
        self.inside: list[str] = []
        self.outside: list[str] = []

    def px(self, x: Array | float) -> Array:
        """Horizontal place of values."""
        values, (low, high) = np.asarray(x, float), self.x
        if self.log_x:
            values, low, high = np.log10(np.maximum(values, 1e-300)), np.log10(low), np.log10(high)
        return self.left + (values - low) / (high - low) * (self.right - self.left)

    def py(self, y: Array | float) -> Array:
        """Vertical place of values."""
        low, high = self.y
        return self.height - BOTTOM - (np.asarray(y, float) - low) / (high - low) * (self.height - TOP - BOTTOM)

    def line(self, x: Array, y: Array, kind: str) -> None:
        """A line through points [n]; where y is not finite, it is broken."""
        parts = np.split(np.arange(len(x)), np.flatnonzero(~np.isfinite(y)))
        runs = [p[np.isfinite(y[p])] for p in parts]
        d = "".join(
            "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(self.px(x[p]), self.py(y[p]), strict=True))
            for p in runs
            if len(p)
        )
        self.inside.append(f'<path class="line {kind}" d="{d}"/>')

    def dots(self, x: Array, y: Array, kind: str) -> None:
        """Points [n], as one path of strokes without length; larger where there are few."""
        few = " few" if len(x) < FEW else ""
        d = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(self.px(x), self.py(y), strict=True))
        self.inside.append(f'<path class="dots {kind}{few}" d="{d}"/>')

    def bar(self, row: int, rows: int, value: float, kind: str, name: str, told: str) -> None:
        """A horizontal bar from the axis to a value, named at its left and told at its end."""
        step = (self.height - TOP - BOTTOM) / rows
        top, end = TOP + step * row, float(self.px(value))
        self.outside.append(
            f'<rect class="bar {kind}" x="{self.left}" y="{top + 0.16 * step:.1f}" '
            f'width="{max(end - self.left, 1):.1f}" height="{0.68 * step:.1f}"/>'
            + text(self.left - 8, top + step / 2 + 4, name, "end")
        )
        self.outside.append(text(end + 7, top + step / 2 + 4, told, "start"))

    def whisker(self, row: int, rows: int, low: float, high: float) -> None:
        """An interval on a bar."""
        step = (self.height - TOP - BOTTOM) / rows
        y = TOP + step * (row + 0.86)
        self.outside.append(f'<path class="whisker" d="M{self.px(low):.1f} {y:.1f}H{self.px(high):.1f}"/>')

    def svg(self, title: str, y_ticks: bool = True) -> str:
        """The whole drawing."""
        right, bottom = self.right, self.height - BOTTOM
        grid, names = [], []
        for v, name in named(ticks(*self.x, log=self.log_x), 4):
            at = float(self.px(v))
            grid.append(f"M{at:.1f} {TOP}V{bottom}")
            names.append(text(at, bottom + 15, name, "middle", "x"))
        for v, name in named(ticks(*self.y), 3) if y_ticks else ():
            at = float(self.py(v))
            grid.append(f"M{self.left} {at:.1f}H{right}")
            names.append(text(self.left - 6, at + 4, name, "end"))
        middle = (TOP + bottom) / 2
        turned = f'transform="rotate(-90 14 {middle:.0f})"'
        zoom = f' data-zoom="{self.x[0]} {self.x[1]} {self.left} {right}"' if self.zoom else ""
        return (
            f'<svg viewBox="0 0 {self.width} {self.height}" role="img" aria-label="{html.escape(title)}"{zoom}>'
            f'<title>{html.escape(title)}</title><path class="grid" d="{"".join(grid)}"/><g class="names">'
            f"{''.join(names)}</g>{text((self.left + right) / 2, self.height - 5, self.labels[0], 'middle')}"
            f'<text x="14" y="{middle:.0f}" text-anchor="middle" {turned}>{html.escape(self.labels[1])}</text>'
            f'<svg x="{self.left}" y="{TOP}" width="{right - self.left}" height="{bottom - TOP}" '
            f'viewBox="{self.left} {TOP} {right - self.left} {bottom - TOP}" preserveAspectRatio="none">'
            f'<g class="plot">{"".join(self.inside)}</g></svg>{"".join(self.outside)}</svg>'
        )


def text(x: float, y: float, words: str, anchor: str, kind: str = "") -> str:
    """Words at a place."""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(words)}</text>'


def ticks(low: float, high: float, log: bool = False) -> list[float]:
    """Round numbers within a range: about five, or powers of ten."""
    if log:
        powers = np.arange(np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9) + 1)
        if len(powers) > 1:
            return [float(10.0**p) for p in powers[:: max(1, len(powers) // 6)]]
    raw = (high - low) / 5
    size = 10 ** np.floor(np.log10(raw))
    step = size * min((1, 2, 5, 10), key=lambda k: abs(k * size - raw))
    first = np.ceil(low / step - 1e-9)
    return [float(k * step) + 0.0 for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]


def named(values: Sequence[float], digits: int) -> list[tuple[float, str]]:
    """Numbers with their names, of so many digits, or as many as tell them apart."""
    while True:
        names = [f"{v:.{digits}g}" for v in values]
        if len(set(names)) == len(set(values)) or digits >= 17:
            return list(zip(values, names, strict=True))
        digits += 1


def span(*values: Array, trim: float = 0.0) -> tuple[float, float]:
    """Range of all finite values, without the outermost share of them, and a little more."""
    every = np.concatenate([v[np.isfinite(v)].ravel() for v in values])
    low, high = np.quantile(every, [trim, 1 - trim]) if len(every) else (0.0, 1.0)
    pad = 0.04 * (high - low)
    return float(low - pad), float(high + pad)


def thinned(count: int, most: int) -> Sequence[int]:
    """Every so many of `count`, at most `most`."""
    return range(0, count, max(1, -(-count // most)))


def _widened(pair: tuple[float, float]) -> tuple[float, float]:
    low, high = pair
    return (low, high) if high > low else (low - 0.5 * abs(low) - 1e-9, high + 0.5 * abs(high) + 1e-9)
