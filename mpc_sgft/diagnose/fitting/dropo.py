"""Distributions of a simulator's numbers that make a recording likely, by their spread too (DROPO)."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.quasirandom import SobolEngine

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.learning.beta import EDGE, beta, quantile
from mpc_sgft.learning.climb import climb

ROUNDS = 8
SAMPLES = 64  # of the numbers, each round
EFFECTIVE = 0.3  # share of the samples that must still count where a round may go

Simulate = Callable[[Array], Array]  # places in the draws' ranges [M, D] -> outcomes [M, W, S]


def dropo(
    simulate: Simulate,
    draws: int,
    measured: Array,
    scale: Array,
    *,
    seed: int,
    rounds: int = ROUNDS,
    samples: int = SAMPLES,
    track: Callable[[range], Iterable[int]] = iter,
) -> Tensor:
    """The Beta distributions nu of the draws, over their ranges, under which the outcomes of windows are likeliest.

        maximise   sum_w log N(s_w; mean_w, cov_w + diag(scale_w^2)),   mean and cov of the outcomes under xi ~ nu

    A spread of outcomes that the scale does not hold widens nu, so that what differs between episodes, or is no draw
    at all, is not forced into one value.

    What differs from the publication: Beta distributions in place of Gaussians, which know no ends; they are found by
    a few rounds, in each of which the outcomes of some draws are simulated once and weighed by nu'(xi) / nu(xi), no
    further than these weights reach, in place of CMA-ES; and the scale is known for each number of each window, where
    there it is one number to be chosen.

    Args:
        simulate: The outcomes of M models in W windows.
        draws: D.
        measured: Outcomes, [W, S].
        scale: Standard deviation of each, if the model were right, [W, S].
        seed: Of the samples.
        rounds, samples: M samples in each round.
        track: Shows how far the rounds are, as tqdm does.

    Returns:
        (a, b) of each Beta, [D, 2]; a, b >= 1.

    Raises:
        ValueError: Without draws or windows.

    Source: Tiboni, Arndt, Kyrki, "DROPO: Sim-to-real transfer with offline domain randomization", Robotics and
    Autonomous Systems 2023, arXiv:2201.08434.
    """
    if draws < 1 or len(measured) < 1:
        raise ValueError(f"draws={draws}, windows={len(measured)}: both must be 1 or more.")
    truth = torch.from_numpy(measured / scale)
    unit = torch.eye(measured.shape[1], dtype=torch.float64)
    engine = SobolEngine(draws, scramble=True, seed=seed)
    here = torch.zeros(draws, 2, dtype=torch.float64)  # logarithms: uniform
    for _ in track(range(rounds)):
        places = quantile(here.exp(), engine.draw(samples, dtype=torch.float64)).clamp(EDGE, 1 - EDGE)  # [M, D]
        outcome = torch.from_numpy(simulate(places.numpy()) / scale)  # [M, W, S]
        density = beta(here).log_prob(places).sum(1)

        def weights(x: Tensor, places: Tensor = places, density: Tensor = density) -> Tensor:
            return torch.softmax(beta(x).log_prob(places).sum(1) - density, 0)  # [M]

        def likely(x: Tensor, outcome: Tensor = outcome) -> Tensor:
            w = weights(x)
            mean = torch.einsum("m,mws->ws", w, outcome)
            off = outcome - mean
            told = (1 - (w**2).sum()).clamp(min=0.5)  # less only where the solver tries what does not reach
            cov = torch.einsum("m,mwi,mwj->wij", w, off, off) / told
            return MultivariateNormal(mean, cov + unit, validate_args=False).log_prob(truth).mean()

        def reaches(x: Tensor) -> Tensor:
            return 1 / (weights(x) ** 2).sum() / samples - EFFECTIVE

        here = climb(likely, [reaches], here)
    return here.exp()
