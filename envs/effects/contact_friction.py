"""Things slide more or less easily than the model says."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from envs.effects.base import Effect, decide, pick


@dataclass(frozen=True)
class ContactFriction(Effect):
    """Set the sliding friction of geoms, and let it decide in each of their contacts (`priority`).

    Where two such effects meet in a contact, the one that is listed last decides.
    """

    coefficient: float = 1.0
    at: tuple[str, ...] = ("puck",)  # geoms
    place: ClassVar[str] = "geom"
    units: ClassVar[dict[str, str]] = {"coefficient": "1"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 10.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        named = pick([*spec.geoms, *spec.flexes], self.at, "geom")
        for geom in named:
            geom.friction[0] = self.coefficient
        decide(spec, named)


EFFECT = ContactFriction
