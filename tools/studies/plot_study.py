"""Learning curves of a study: mean over seeds with a bootstrap interval, a panel for each gap.

    python -m tools.studies.plot_study results/transfer/sgft.csv results/transfer/tdmpc2.csv OUT.png

For the results page OUT.png is results/transfer/transfer.png. Takes seconds.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.stats import bootstrap

from tools.studies.runner import read_curves

COLOURS = {  # of a method in every figure
    "sgft": "#1f77b4",
    "sgft_paper": "#17becf",
    "sgft_sac": "#2ca02c",
    "pbrs": "#9467bd",
    "tdmpc2": "#d62728",
    "sac": "#ff7f0e",
    "rlpd": "#8c564b",
    "iql": "#7f7f7f",
    "h2o": "#bcbd22",
    "asap": "#e377c2",
    "zero_shot": "#333333",
}
Curves = dict[str, dict[str, dict[int, list[float]]]]  # gap -> label -> rollouts -> of each seed


def values(paths: list[Path], column: str = "success") -> Curves:
    """Success, or another column, of each seed."""
    curves: Curves = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for gap, methods in read_curves(paths).items():
        for label, seeds in methods.items():
            for curve in seeds.values():
                for count, row in curve.items():
                    curves[gap][label][count].append(float(row[column]))
    return curves


def interval(values: list[float]) -> tuple[float, float]:
    """95 % bootstrap interval of the mean; a single or constant sample is its own interval."""
    if len(set(values)) < 2:
        return values[0], values[0]
    found = bootstrap((np.array(values),), np.mean, method="percentile", rng=np.random.default_rng(0))
    return found.confidence_interval


def panel(axis: Axes, title: str, lines: dict[str, dict[int, list[float]]]) -> None:
    """Mean over the seeds by real rollouts, and its interval, a line a label."""
    for label, points in lines.items():
        x = sorted(points)
        mean = [np.mean(points[k]) for k in x]
        low, high = zip(*(interval(points[k]) for k in x), strict=True)
        seeds = f"{label}, seeds: {len(points[x[0]])}"
        (line,) = axis.plot(x, mean, marker="o", markersize=3, label=seeds, color=COLOURS.get(label))
        axis.fill_between(x, low, high, alpha=0.2, color=line.get_color())
    axis.set(title=title, xlabel="real rollouts")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False, fontsize="small")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("csv", type=Path, nargs="+")
    parser.add_argument("png", type=Path)
    args = parser.parse_args()
    curves = values(args.csv)
    figure, axes = plt.subplots(1, len(curves), figsize=(4.2 * len(curves), 3.4), sharey=True, squeeze=False)
    for axis, (gap, methods) in zip(axes[0], curves.items(), strict=True):
        panel(axis, f"gap: {gap}", methods)
        axis.set_ylim(-0.02, 1.02)
    axes[0][0].set_ylabel("success, mean and 95 % bootstrap")
    figure.tight_layout()
    args.png.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.png, dpi=130)


if __name__ == "__main__":
    main()
