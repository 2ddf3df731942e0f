"""The confusion matrix and the power curves of a benchmark, as pictures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mpc_sgft.runs.proportion import wilson
from tools.studies.blind.score import named, top1

EDGES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 10.5)  # multiples of the detectable size
NOT_NAMES = ("none", "unknown", "not_identifiable", "error")


def confusion(
    reports: Mapping[str, Mapping[str, Any]], labels: Mapping[str, Mapping[str, Any]]
) -> tuple[list[str], list[str], np.ndarray]:
    """Rows (truth), columns (answer), counts, of single effects, no effect and what is outside the library.

    A set of several names counts under `several`.
    """
    pairs = []
    for name, label in labels.items():
        if name in reports and label["group"] in ("single", "none", "outside"):
            truth = label["effects"][0]["name"] if label["effects"] else "none"
            said = named(reports[name])
            answer = reports[name]["verdict"] if not said else said[0] if len(said) == 1 else "several"
            pairs.append((truth, answer))
    rows = sorted({t for t, _ in pairs})
    seen = {a for _, a in pairs}
    columns = [r for r in rows if r not in NOT_NAMES] + sorted(seen - set(rows) - set(NOT_NAMES)) + list(NOT_NAMES)
    counts = np.zeros((len(rows), len(columns)), int)
    for truth, answer in pairs:
        counts[rows.index(truth), columns.index(answer)] += 1
    return rows, columns, counts


def power(
    reports: Mapping[str, Mapping[str, Any]], labels: Mapping[str, Mapping[str, Any]], split: str
) -> dict[str, list[tuple[float, int, int]]]:
    """Single effects, by value of a label such as `noise_level`: (middle multiple, right names, cases) of each bin."""
    curves: dict[str, list[tuple[float, int, int]]] = {}
    single = [(reports[n], y) for n, y in labels.items() if n in reports and y["group"] == "single"]
    for value in sorted({y[split] for _, y in single}):
        points = []
        for low, high in zip(EDGES, EDGES[1:], strict=False):
            bin_ = [(r, y) for r, y in single if y[split] == value and low <= y["effects"][0]["multiple"] < high]
            points.append((float(np.sqrt(low * high)), sum(top1(r, y) for r, y in bin_), len(bin_)))
        curves[str(value)] = points
    return curves


def draw(
    reports: Mapping[str, Mapping[str, Any]], labels: Mapping[str, Mapping[str, Any]], folder: Path, stem: str
) -> list[Path]:
    """Write <stem>_confusion.png and <stem>_power.png; returns their paths."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    rows, columns, counts = confusion(reports, labels)
    figure, axes = plt.subplots(figsize=(2 + 0.35 * len(columns), 2 + 0.3 * len(rows)), layout="constrained")
    shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(
            j, i, str(counts[i, j]), ha="center", va="center", fontsize=8, color="w" if shares[i, j] > 0.5 else "k"
        )
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set(xlabel="answer", ylabel="truth", title="single effects, no effect, outside the library (cases)")
    paths = [folder / f"{stem}_confusion.png", folder / f"{stem}_power.png"]
    figure.savefig(paths[0], dpi=130)
    plt.close(figure)

    figure, panels = plt.subplots(1, 3, figsize=(13, 4), sharey=True, layout="constrained")
    for axes, split in zip(panels, ("noise_level", "seconds", "plant"), strict=True):
        for value, points in power(reports, labels, split).items():
            some = [(x, hits / n, *wilson(hits, n)) for x, hits, n in points if n]
            if some:
                x, y, low, high = np.array(some).T
                line = axes.plot(x, y, marker="o", markersize=3, label=value)[0]
                axes.fill_between(x, low, high, alpha=0.1, color=line.get_color())
        axes.axvline(2.0, color="0.6", linewidth=0.8)
        axes.set(xscale="log", xlabel="size / detectable size", title=f"by {split}", ylim=(0, 1.02))
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    panels[0].set_ylabel("single effect named rightly")
    figure.savefig(paths[1], dpi=130)
    plt.close(figure)
    return paths
