"""A rope, a cable or a belt is longer than the model says, or shorter."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, pick


@dataclass(frozen=True)
class RopeLength(Effect):
    """Multiply the greatest length of tendons by `scale` (`tendon_range`).

    Raises:
        ValueError: From `edit_spec`, for a tendon without a greatest length, or where there is no tendon to change.
    """

    scale: float = 1.0
    at: tuple[str, ...] = ()  # tendons; all if empty
    place: ClassVar[str] = "tendon"
    units: ClassVar[dict[str, str]] = {"scale": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"scale": (0.1, 10.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        if self.scale != 1 and not spec.tendons:
            raise ValueError(f"rope_length.scale={self.scale}: this scene has no tendons")
        for tendon in pick(spec.tendons, self.at, "tendon"):
            shortest, longest = tendon.range
            if shortest >= longest:
                raise ValueError(f"rope_length: tendon {tendon.name!r} has no greatest length in this scene")
            tendon.range = [shortest, self.scale * longest]


EFFECT = RopeLength
