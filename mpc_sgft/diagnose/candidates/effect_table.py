"""Effects that diagnose looks for: sizes, starts, and which of them contain or imitate one another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

IDLE = 1e-6  # of the forces that a joint moves by: an actuator that never gave more did nothing


class TypicalSizes(NamedTuple):
    """Typical sizes at one place: what "large" means there."""

    force: float = 1.0  # N or N m, of the joint's generalised force
    speed: float = 1.0  # m/s or rad/s
    travel: float = 1.0  # m or rad, spread of the position
    centre: float = 0.0  # m or rad, middle of the motion
    inertia: float = 1.0  # kg or kg m^2 at the joint
    command: float = 1.0  # of the actuator
    peak: float = 1.0  # largest force of the actuator, N or N m
    needed: float = 0.5  # largest force that the measured motion asks of it, N or N m
    mass: float = 1.0  # kg of the body
    friction: float = 1.0  # sliding friction of the geom's contacts
    dt: float = 0.001  # s between samples

    @property
    def idle(self) -> bool:
        """Whether an actuator does nothing in the measured motion."""
        return self.peak <= IDLE * self.force


class Parameter(NamedTuple):
    """One parameter. Starts and bounds are counted from the neutral value in the typical size."""

    neutral: float | Callable[[TypicalSizes], float]
    size: Callable[[TypicalSizes], float]
    starts: tuple[float | Callable[[TypicalSizes], float], ...] = (0.1,)
    low: float = -100.0
    high: float = 100.0
    hop: Callable[[TypicalSizes], float] = lambda s: 0.0  # between values that fit about as well; fits try them too


class EffectFacts(NamedTuple):
    """What diagnose must know of an effect beside its physics."""

    parameters: Mapping[str, Parameter]
    driven: bool = False  # only where a motor sits
    commanded: bool = False  # only where that motor does something
    sums: Mapping[str, tuple[str, str]] = {}  # the effect's parameter -> fitted ones that it is the sum of
    variants: Sequence[Mapping[str, float]] = ({},)  # parameters that are held, one candidate each


def _saturated(s: TypicalSizes) -> float:
    """Wherever the motion needs most."""
    return min(s.needed / s.peak, 1.0) - 1


_force, _viscous = (lambda s: s.force), (lambda s: s.force / s.speed)
_tilt = Parameter(0.0, lambda s: 0.1, (0.2,), -5.0, 5.0)

TABLE: dict[str, EffectFacts] = {
    "viscous_friction": EffectFacts({"coefficient": Parameter(0.0, _viscous)}),
    "coulomb_friction": EffectFacts({"torque": Parameter(0.0, _force)}),
    "asymmetric_friction": EffectFacts({"forward": Parameter(0.0, _viscous), "backward": Parameter(0.0, _viscous)}),
    "stribeck_friction": EffectFacts(
        {
            "coulomb": Parameter(0.0, _force),
            "excess": Parameter(0.0, _force, low=0.0),
            "velocity": Parameter(0.0, lambda s: s.speed, (0.1, 0.5), 0.01, 3.0),
            "deflection": Parameter(0.0, lambda s: 1e-3 * s.travel, (1.0,), 0.1, 50.0),
            "damping_ratio": Parameter(0.0, lambda s: 1.0, (0.1,), 0.02, 2.0),
        },
        sums={"static": ("coulomb", "excess")},
        variants=({"deflection": 0.0, "damping_ratio": 0.5}, {}),
    ),
    "load_dependent_friction": EffectFacts({"coefficient": Parameter(0.0, lambda s: 1.0, (0.05,))}, driven=True),
    "quadratic_drag": EffectFacts({"coefficient": Parameter(0.0, lambda s: s.force / s.speed**2)}),
    "joint_stiffness": EffectFacts(
        {
            "stiffness": Parameter(0.0, lambda s: s.force / s.travel),
            "rest": Parameter(lambda s: s.centre, lambda s: s.travel, (0.0, -3.0, 3.0), -5.0, 5.0),
        }
    ),
    "armature": EffectFacts({"inertia": Parameter(0.0, lambda s: s.inertia)}),
    "backlash": EffectFacts(
        {"gap": Parameter(0.0, lambda s: 0.1 * s.travel, (0.003, 0.03, 0.3), 0.0, 10.0)}, driven=True
    ),
    "flexible_joint": EffectFacts(
        {"compliance": Parameter(0.0, lambda s: 0.1 * s.travel / s.force, (0.02, 0.07, 0.25, 0.8), 0.0, 10.0)},
        driven=True,
    ),
    "gravity_tilt": EffectFacts({"angle": _tilt, "roll": _tilt}, variants=({"roll": 0.0}, {"angle": 0.0}, {})),
    "payload": EffectFacts({"mass": Parameter(0.0, lambda s: s.mass, (0.2,))}),
    "contact_friction": EffectFacts(
        {"coefficient": Parameter(lambda s: s.friction, lambda s: 0.5 * s.friction, (-0.5, 0.5, 2.0), -2.0, 10.0)}
    ),
    "contact_softness": EffectFacts({"time_constant": Parameter(0.0, lambda s: 0.02, (0.25, 1.0), 0.0, 45.0)}),
    "actuator_gain": EffectFacts({"gain": Parameter(1.0, lambda s: 1.0, (-0.1, 0.1), -0.95, 2.0)}, commanded=True),
    "actuator_offset": EffectFacts({"offset": Parameter(0.0, lambda s: s.command, (0.05, -0.05))}),
    "deadband": EffectFacts({"width": Parameter(0.0, lambda s: s.command, (0.05, 0.3), 0.0, 3.0)}, commanded=True),
    "torque_saturation": EffectFacts(
        {"limit": Parameter(lambda s: s.peak, lambda s: s.peak, (-0.15, -0.5, -0.75, -0.88, _saturated), -0.999, 0.0)},
        commanded=True,
    ),
    "sensor_offset": EffectFacts({"offset": Parameter(0.0, lambda s: s.travel, (0.1, -0.1), -3.0, 3.0)}),
    "sensor_gain": EffectFacts({"gain": Parameter(1.0, lambda s: 1.0, (-0.05, 0.05), -0.8, 2.0)}),
    "actuator_delay": EffectFacts(
        {"delay": Parameter(0.0, lambda s: 0.02, (0.25, 1.0), 0.0, 15.0, lambda s: s.dt)}, commanded=True
    ),
    "sensor_delay": EffectFacts({"delay": Parameter(0.0, lambda s: 0.02, (0.25, 1.0), 0.0, 15.0)}),
    "actuator_lag": EffectFacts(
        {"time_constant": Parameter(0.0, lambda s: 0.02, (0.25, 1.0), 0.0, 15.0)}, commanded=True
    ),
}

# richer effect -> simpler one -> {parameter of the richer: parameter of the simpler that gives the same physics}
INCLUDES: dict[str, dict[str, dict[str, str]]] = {
    "asymmetric_friction": {"viscous_friction": {"forward": "coefficient", "backward": "coefficient"}},
    "stribeck_friction": {"coulomb_friction": {"coulomb": "torque"}},
}


# effects that do much the same to a slow motion with the same number
ALIKE = [{"actuator_delay", "actuator_lag"}]


class Equivalence(NamedTuple):
    """Effects that data of this kind cannot separate where `reason` applies.

    Attributes:
        effects: Their names.
        reason: Why, and what would separate them.
        canonical: The name that is reported if they tie, because all of them are one term of the equations; None if
            the answer is then `not_identifiable`.
    """

    effects: frozenset[str]
    reason: str
    canonical: str | None = None


EQUIVALENT = [
    Equivalence(
        frozenset({"actuator_offset", "gravity_tilt"}),
        "a constant force along a slide: an offset of its drive and a tilt of its base are the same term of the "
        "equations; a spirit level, or a second axis, tells them apart",
        "actuator_offset",
    ),
    Equivalence(
        frozenset({"sensor_offset", "gravity_tilt"}),
        "an encoder's offset at the first hinge of a machine turns all of it against gravity, and so does a tilted "
        "base; a spirit level tells them apart",
    ),
    Equivalence(
        frozenset({"payload", "armature"}),
        "on a slide, or a hinge without gravity, a load and a rotor are the same inertia; weigh the load",
    ),
    Equivalence(
        frozenset({"actuator_gain", "payload", "armature", "sensor_gain"}),
        "where inertia is all that resists, force over inertia is all that shows; a measured force or a known load "
        "separates them",
    ),
    Equivalence(
        frozenset({"contact_friction", "coulomb_friction"}),
        "what is pressed against a surface by a constant force rubs like a dry joint; press harder, or lift it off",
    ),
    Equivalence(
        frozenset({"actuator_delay", "sensor_delay"}),
        "a loop does not show which side is late; a measured force or current does",
        "actuator_delay",
    ),
]
