"""Learning curves of a study: mean over seeds with a bootstrap interval, a panel for each gap.

    python -m tools.studies.plot_study results/transfer/sgft.csv results/transfer/tdmpc2.csv OUT.png

For the results page OUT.png is results/transfer/transfer.png. Takes seconds.
"""

import argparse
import csv
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import bootstrap

COLOURS = {"sgft": "#1f77b4", "tdmpc2": "#d62728"}


def read(paths: list[Path]) -> dict[str, dict[str, dict[int, list[float]]]]:
    """gap -> label -> rollouts -> success of each seed."""
    curves: dict = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for path in paths:
        with path.open() as file:
            for row in csv.DictReader(file):
                label = " ".join(x for x in (row["method"], row["variant"]) if x)
                curves[row["gap"]][label][int(row["rollouts"])].append(float(row["success"]))
    return curves


def interval(values: list[float]) -> tuple[float, float]:
    """95 % bootstrap interval of the mean; a single or constant sample is its own interval."""
    if len(set(values)) < 2:
        return values[0], values[0]
    found = bootstrap((np.array(values),), np.mean, method="percentile", rng=np.random.default_rng(0))
    return found.confidence_interval


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("csv", type=Path, nargs="+")
    parser.add_argument("png", type=Path)
    args = parser.parse_args()
    curves = read(args.csv)
    figure, axes = plt.subplots(1, len(curves), figsize=(4.2 * len(curves), 3.4), sharey=True, squeeze=False)
    for axis, (gap, methods) in zip(axes[0], curves.items(), strict=True):
        for label, points in methods.items():
            x = sorted(points)
            mean = [np.mean(points[k]) for k in x]
            low, high = zip(*(interval(points[k]) for k in x), strict=True)
            colour = COLOURS.get(label)
            (line,) = axis.plot(
                x, mean, marker="o", markersize=3, label=f"{label}, seeds: {len(points[x[0]])}", color=colour
            )
            axis.fill_between(x, low, high, alpha=0.2, color=line.get_color())
        axis.set(title=f"gap: {gap}", xlabel="real rollouts", ylim=(-0.02, 1.02))
        axis.grid(alpha=0.3)
        axis.legend(frameon=False)
    axes[0][0].set_ylabel("success, mean and 95 % bootstrap")
    figure.tight_layout()
    args.png.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.png, dpi=130)


if __name__ == "__main__":
    main()
