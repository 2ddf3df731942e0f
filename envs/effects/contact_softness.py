"""Things give way where they touch: foam, rubber, a mat."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from envs.effects.base import Effect, decide, pick


@dataclass(frozen=True)
class ContactSoftness(Effect):
    """Add to the time constant of geoms' contacts (`geom_solref`); their damping ratio stays.

    A contact's stiffness falls with the square of its time constant. Named geoms decide in each of their contacts
    (`priority`); without names all contacts get softer by the same. Contacts listed as `<pair>` with numbers of their
    own are left alone.
    """

    time_constant: float = 0.0
    at: tuple[str, ...] = ()  # geoms; all if empty
    place: ClassVar[str] = "geom"
    units: ClassVar[dict[str, str]] = {"time_constant": "s"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"time_constant": (0.0, 1.0)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        if not self.time_constant:
            return
        named = pick(spec.geoms, self.at, "geom")
        for geom in named:
            first, second = geom.solref
            if first > 0:
                geom.solref[0] = first + self.time_constant
            else:  # (-stiffness, -damping): the same damping ratio at a longer time constant
                if not second:
                    raise ValueError(f"contact_softness: the contacts of geom {geom.name!r} have no damping (solref)")
                own = 2 / -second
                scale = own / (own + self.time_constant)
                geom.solref = np.array([first * scale**2, second * scale])
        if self.at:
            decide(spec, named)


EFFECT = ContactSoftness
