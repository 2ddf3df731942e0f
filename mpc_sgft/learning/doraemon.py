"""Domain randomisation that widens by itself: as random as possible while the policy still succeeds (DORAEMON)."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import kl_divergence

from mpc_sgft.learning.beta import EDGE, MOST, beta
from mpc_sgft.learning.climb import climb


class Doraemon:
    """Each draw of the randomisation has a Beta distribution over its range, at first a narrow one around the middle.

        maximise H(nu')   subject to   E_nu' [success] >= alpha   and   KL(nu' | nu) <= epsilon

    with the expectation from the last episodes, weighed by nu'(xi) / nu(xi). Where no such nu' is near enough, success
    is maximised first. The uniform distribution has the highest entropy, so the ranges are the most that is reached.

    What differs from the publication: SLSQP in place of a trust-region solver, and the policy that is asked is the one
    that explores, of the copies that make no detours.

    Args:
        draws: D, of the randomisation.
        success: alpha, the share of episodes that must succeed.
        trust: epsilon, how far one change may go, nats.
        concentration: a + b of the first Beta distribution.
        episodes: To wait for before each change.

    Raises:
        ValueError: If a number is out of range, or nothing is randomised.

    Source: Tiboni et al., "Domain Randomization via Entropy Maximization", ICLR 2024, arXiv:2311.01885.
    """

    def __init__(self, draws: int, *, success: float, trust: float, concentration: float, episodes: int) -> None:
        if draws < 1:
            raise ValueError("nothing is randomised that could widen: give `randomize` some draws")
        if not 0 < success < 1:
            raise ValueError(f"success={success}: the share of episodes that must succeed lies between 0 and 1.")
        if trust <= 0 or episodes < 1 or not 2 <= concentration <= 2 * MOST:
            raise ValueError(
                f"trust={trust} must be above 0, episodes={episodes} 1 or more, and concentration={concentration} "
                f"between 2 (uniform) and {2 * MOST:g}."
            )
        self.success, self.trust, self.episodes = success, trust, episodes
        self.shapes = torch.full((draws, 2), concentration / 2, dtype=torch.float64)  # (a, b) of each Beta
        self._seen: list[tuple[Tensor, Tensor, Tensor]] = []  # places [n, D], success [n], log density [n]

    @property
    def entropy(self) -> float:
        """Of all draws together, nats; 0 is uniform, below is narrower."""
        return float(beta(self.shapes.log()).entropy().sum())

    def record(self, places: Tensor, success: Tensor, shapes: Sequence[Sequence[float]]) -> dict[str, float]:
        """Take in a round of episodes, and widen or narrow once there are enough; returns metrics.

        Args:
            places: Of the draws in their ranges, 0 to 1, [N, D]; rows with nan are left out.
            success: Of each episode, bool [N].
            shapes: That the places were drawn from: those of this round, which may be older than the present ones.
        """
        told = places.isfinite().all(1)
        places = places[told].double().clamp(EDGE, 1 - EDGE)
        drawn_from = beta(torch.tensor(shapes, dtype=torch.float64).log())
        self._seen.append((places, success[told].double(), drawn_from.log_prob(places).sum(1)))
        if sum(len(part[0]) for part in self._seen) >= self.episodes:
            self._change(*(torch.cat(column) for column in zip(*self._seen, strict=True)))
            self._seen.clear()
        return {"randomize_entropy": self.entropy}

    def _change(self, places: Tensor, success: Tensor, log_density: Tensor) -> None:
        here = self.shapes.log()
        old = beta(here)

        def succeeds(x: Tensor) -> Tensor:
            return ((beta(x).log_prob(places).sum(1) - log_density).exp() * success).mean() - self.success

        def near(x: Tensor) -> Tensor:
            return self.trust - kl_divergence(beta(x), old).sum()

        def entropy(x: Tensor) -> Tensor:
            return beta(x).entropy().sum()

        if succeeds(here) < 0:
            here = climb(succeeds, [near], here)
        if succeeds(here) >= 0:
            here = climb(entropy, [near, succeeds], here)
        self.shapes = here.exp()

    def state_dict(self) -> dict[str, Any]:
        """What must be kept to go on exactly."""
        return {"shapes": self.shapes.clone(), "seen": list(self._seen)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.shapes, self._seen = state["shapes"], [tuple(part) for part in state["seen"]]
