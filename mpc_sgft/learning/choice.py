"""What acts, by how it predicted rollouts that nobody had trained on."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple


class Choice(NamedTuple):
    """Errors of two variants on a rollout, and whether the second acts in the next one."""

    plain: float
    rival: float
    rival_acts: bool


class Verdict(NamedTuple):
    """How the dynamics predicted a rollout that nobody had trained on, and what acts in the next one."""

    pretrained: float  # latent error over the horizon, mean over steps
    fine_tuned: float
    accepted: bool  # the fine-tuned parts act
    beneath: bool = True  # the dynamics beneath the maps are among these
    mapped: float | None = None  # error of the pretrained dynamics with the learned maps, where it is asked for
    band: Choice | None = None  # of these, with the first command map and with the second, which has a dead band
    suspicion: Choice | None = None  # with the command map that acts, without and with what sensors are suspected of
    success: bool = False  # the rollout reached its goal
    episode: int = 0  # number of the rollout

    def with_maps_of(self, other: "Verdict") -> float | None:
        """Error of the pretrained dynamics on this rollout with the maps that act after `other`."""
        if self.suspicion and other.suspicion and other.suspicion.rival_acts:
            return self.suspicion.rival
        if self.band and other.band and other.band.rival_acts:
            return self.band.rival
        return self.mapped

    def metrics(self) -> dict[str, float]:
        """By name, as metrics.csv has them."""
        metrics = {"error_pretrained": self.pretrained, "error_fine_tuned": self.fine_tuned}
        if self.mapped is not None:
            metrics["error_mapped"] = self.mapped
        if self.band is not None:
            metrics |= {"error_banded": self.band.rival, "band_acts": float(self.band.rival_acts)}
        if self.suspicion is not None:
            acts = float(self.suspicion.rival_acts)
            metrics |= {"error_suspected": self.suspicion.rival, "suspicion_acts": acts}
        return metrics

    def state(self) -> dict[str, Any]:
        """As plain tuples and numbers, by name."""
        return {k: tuple(v) if isinstance(v, Choice) else v for k, v in self._asdict().items()}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Verdict":
        """From `state`."""
        verdict = cls(**state)
        return verdict._replace(
            band=verdict.band and Choice(*verdict.band), suspicion=verdict.suspicion and Choice(*verdict.suspicion)
        )


def begins(pairs: Iterable[tuple[float, float]], acts: bool, margin: float) -> bool:
    """Whether the first of each pair of errors, one a rollout, are clearly lower; of what acts already: lower at all.

    Args:
        pairs: Errors of what could act, and of what would without it.
        acts: It does already.
        margin: To begin, the geometric mean of its errors must be less than this share of that of the others.
    """
    ours, others = zip(*pairs, strict=True)
    share = 1.0 if acts else margin
    return math.prod(ours) < math.prod(share * x for x in others)
