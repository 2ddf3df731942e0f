"""Four plants, with equations of motion derived by hand (Lagrange), for many rows at once.

Positions q and velocities v are [R, n]; parameters are a mapping of names to arrays with R rows. All plants obey

    M(q) dv/dt + bias(q, v) = generalised force

Angles are measured from hanging straight down and are positive toward +x; z is up. Gravity of 9.81 m/s^2 may be turned
by `tilt` [rad] about the horizontal axis, so that a body of mass m feels m g (sin tilt, -cos tilt) in (x, z).
`payload` [kg] is a point mass at the end of the last body (on the slide: on the carriage).
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Rows = Mapping[str, Array]
G = 9.81  # [m/s^2]


class Machine(Protocol):
    """What the parts of any machine are called."""

    @property
    def joints(self) -> tuple[str, ...]: ...
    @property
    def actuators(self) -> tuple[str, ...]: ...
    @property
    def tip(self) -> str: ...
    @property
    def n(self) -> int: ...


class Plant(NamedTuple):
    """One kind of machine.

    Attributes:
        name: Its name.
        joints: Joint names, in the order of q.
        kinds: "slide" or "hinge" for each joint.
        actuators: Actuator names; actuator i drives joint i.
        servo: Whether the actuators are position servos (command: target) rather than motors (command: force / gear).
        tip: Name of the body that carries the payload.
        mass: M(q), [R, n, n].
        bias: Coriolis, centrifugal and gravity forces, [R, n].
        energy: Kinetic plus potential energy [J], [R].
    """

    name: str
    joints: tuple[str, ...]
    kinds: tuple[str, ...]
    actuators: tuple[str, ...]
    servo: bool
    tip: str
    mass: Callable[[Array, Rows], Array]
    bias: Callable[[Array, Array, Rows], Array]
    energy: Callable[[Array, Array, Rows], Array]

    @property
    def n(self) -> int:
        return len(self.joints)


def _kinetic(mass: Callable[[Array, Rows], Array], q: Array, v: Array, p: Rows) -> Array:
    return 0.5 * np.einsum("ri,rij,rj->r", v, mass(q, p), v)


def _slide_mass(q: Array, p: Rows) -> Array:
    """(m + payload + armature)"""
    return (p["m"] + p["payload"] + p["armature"][:, 0])[:, None, None]


def _slide_bias(q: Array, v: Array, p: Rows) -> Array:
    """Only a tilted gravity acts along the slide."""
    return (-(p["m"] + p["payload"]) * G * np.sin(p["tilt"]))[:, None]


def _slide_energy(q: Array, v: Array, p: Rows) -> Array:
    return _kinetic(_slide_mass, q, v, p) - (p["m"] + p["payload"]) * G * np.sin(p["tilt"]) * q[:, 0]


def _pendulum_mass(q: Array, p: Rows) -> Array:
    """I + m c^2 + payload l^2 + armature, with the centre of mass at c and the end at l"""
    return (p["i"] + p["m"] * p["c"] ** 2 + p["payload"] * p["l"] ** 2 + p["armature"][:, 0])[:, None, None]


def _pendulum_bias(q: Array, v: Array, p: Rows) -> Array:
    """(m c + payload l) g sin(q - tilt)"""
    return ((p["m"] * p["c"] + p["payload"] * p["l"]) * G)[:, None] * np.sin(q - p["tilt"][:, None])


def _pendulum_energy(q: Array, v: Array, p: Rows) -> Array:
    potential = -(p["m"] * p["c"] + p["payload"] * p["l"]) * G * np.cos(q[:, 0] - p["tilt"])
    return _kinetic(_pendulum_mass, q, v, p) + potential


def prepare(plant: "Plant", p: Rows) -> dict[str, Array]:
    """The parameters together with sums of them that do not change while a machine moves; only saves time."""
    sums = {"arm": _arm_sums, "cartpole": _cart_sums}.get(plant.name)
    return dict(p) if sums is None else {**p, "sums": np.stack(sums(p), 1)}


def _sums(p: Rows, sums: Callable[[Rows], tuple[Array, ...]]) -> Iterable[Array]:
    return p["sums"].T if "sums" in p else sums(p)


def _arm_sums(p: Rows) -> tuple[Array, Array, Array, Array, Array]:
    """Inertia of link 1 (with link 2 as a point at the elbow), inertia of link 2, coupling, first moments of both."""
    m2 = p["m2"] + p["payload"]
    s2 = p["m2"] * p["c2"] + p["payload"] * p["l2"]
    i1 = p["i1"] + p["m1"] * p["c1"] ** 2 + m2 * p["l1"] ** 2
    i2 = p["i2"] + p["m2"] * p["c2"] ** 2 + p["payload"] * p["l2"] ** 2
    return i1, i2, s2 * p["l1"], p["m1"] * p["c1"] + m2 * p["l1"], s2


def _arm_mass(q: Array, p: Rows) -> Array:
    """q1 absolute, q2 relative to link 1: [[i1 + i2 + 2 k cos q2, i2 + k cos q2], [.., i2]] + armature"""
    i1, i2, k, _, _ = _sums(p, _arm_sums)
    kc = k * np.cos(q[:, 1])
    m = np.empty((len(q), 2, 2))
    m[:, 0, 0] = i1 + i2 + 2 * kc + p["armature"][:, 0]
    m[:, 0, 1] = m[:, 1, 0] = i2 + kc
    m[:, 1, 1] = i2 + p["armature"][:, 1]
    return m


def _arm_bias(q: Array, v: Array, p: Rows) -> Array:
    """k sin q2 (-(2 v1 v2 + v2^2), v1^2) + g (s1 sin q1' + s2 sin(q1' + q2), s2 sin(q1' + q2)), q1' = q1 - tilt"""
    _, _, k, s1, s2 = _sums(p, _arm_sums)
    h = k * np.sin(q[:, 1])
    outer = s2 * G * np.sin(q[:, 0] + q[:, 1] - p["tilt"])
    b = np.empty_like(q)
    b[:, 0] = -h * v[:, 1] * (2 * v[:, 0] + v[:, 1]) + s1 * G * np.sin(q[:, 0] - p["tilt"]) + outer
    b[:, 1] = h * v[:, 0] ** 2 + outer
    return b


def _arm_energy(q: Array, v: Array, p: Rows) -> Array:
    _, _, _, s1, s2 = _sums(p, _arm_sums)
    potential = -G * (s1 * np.cos(q[:, 0] - p["tilt"]) + s2 * np.cos(q[:, 0] + q[:, 1] - p["tilt"]))
    return _kinetic(_arm_mass, q, v, p) + potential


def _cart_sums(p: Rows) -> tuple[Array, Array, Array]:
    """Moving mass, first moment of the pole, inertia of the pole about its hinge."""
    s = p["m2"] * p["c2"] + p["payload"] * p["l2"]
    return p["m1"] + p["m2"] + p["payload"], s, p["i2"] + p["m2"] * p["c2"] ** 2 + p["payload"] * p["l2"] ** 2


def _cart_mass(q: Array, p: Rows) -> Array:
    """[[m, s cos q2], [s cos q2, i]] + armature"""
    total, s, i = _sums(p, _cart_sums)
    m = np.empty((len(q), 2, 2))
    m[:, 0, 0] = total + p["armature"][:, 0]
    m[:, 0, 1] = m[:, 1, 0] = s * np.cos(q[:, 1])
    m[:, 1, 1] = i + p["armature"][:, 1]
    return m


def _cart_bias(q: Array, v: Array, p: Rows) -> Array:
    """(-s sin q2 v2^2 - m g sin tilt, s g sin(q2 - tilt))"""
    total, s, _ = _sums(p, _cart_sums)
    b = np.empty_like(q)
    b[:, 0] = -s * np.sin(q[:, 1]) * v[:, 1] ** 2 - total * G * np.sin(p["tilt"])
    b[:, 1] = s * G * np.sin(q[:, 1] - p["tilt"])
    return b


def _cart_energy(q: Array, v: Array, p: Rows) -> Array:
    total, s, _ = _sums(p, _cart_sums)
    potential = -total * G * np.sin(p["tilt"]) * q[:, 0] - s * G * np.cos(q[:, 1] - p["tilt"])
    return _kinetic(_cart_mass, q, v, p) + potential


PLANTS: dict[str, Plant] = {
    "slide": Plant(
        "slide", ("slide",), ("slide",), ("motor",), False, "carriage", _slide_mass, _slide_bias, _slide_energy
    ),
    "pendulum": Plant(
        "pendulum", ("hinge",), ("hinge",), ("servo",), True, "arm", _pendulum_mass, _pendulum_bias, _pendulum_energy
    ),
    "arm": Plant(
        "arm",
        ("shoulder", "elbow"),
        ("hinge", "hinge"),
        ("motor1", "motor2"),
        False,
        "link2",
        _arm_mass,
        _arm_bias,
        _arm_energy,
    ),
    "cartpole": Plant(
        "cartpole",
        ("cart", "pole"),
        ("slide", "hinge"),
        ("motor",),
        False,
        "pole",
        _cart_mass,
        _cart_bias,
        _cart_energy,
    ),
}
