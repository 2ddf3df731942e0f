"""Every effect of the benchmark: where it can sit, how its size enters the truth, what the solver should report.

A size is one number. `shape` holds fixed secondary choices (sign, ratio) between 0 and 1 drawn with the case. Scales
come from a run without the effect: F typical force of the joint, V speed, top the highest speed, Q travel, J inertia,
U command, peak the largest force of the drive, gear its force per command (1 for a servo), M the mass of the body that
would carry a payload.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from tools.studies.blind.plants import PLANTS, Array, Machine

Scales = Mapping[str, float]
Shape = Mapping[str, float]
SMALLEST_TIME = 0.001  # [s] delays and lags below half the solver's time step are not asked for
TRANSMISSION = (2000.0, 0.3)  # [rad/s] and damping ratio of the rotor against the flank of a gear with play


class Entry(NamedTuple):
    """One effect.

    Attributes:
        sits: Kind of place: "joint", "actuator", "body", "signal" or "scene".
        guess: A size to begin the search for the detectable one with.
        largest: The largest sensible size.
        apply: apply(truth, rows, joint, size, shape, scales) writes it into the arrays of `truths.rows`.
        report: report(size, shape, scales, nominal joint values) is what a perfect solver would report.
        smallest: The smallest size that is asked for.
    """

    sits: str
    guess: Callable[[Scales], float]
    largest: Callable[[Scales], float]
    apply: Callable[[dict[str, Array], Array, int, float, Shape, Scales], None]
    report: Callable[[float, Shape, Scales], dict[str, float]]
    smallest: float = 0.0


def _sign(shape: Shape) -> float:
    return 1.0 if shape["sign"] >= 0.5 else -1.0


def _add(*names: str) -> Callable[..., None]:
    """Adds the size to these per-joint arrays."""

    def apply(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
        for name in names:
            p[name][rows, joint] += size

    return apply


def _signed(name: str) -> Callable[..., None]:
    """Adds the size with the case's sign."""

    def apply(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
        p[name][rows, joint] += _sign(shape) * size

    return apply


def _asymmetric(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    forward, backward = _directions(size, shape)
    p["b_pos"][rows, joint] += forward
    p["b_neg"][rows, joint] += backward


def _directions(size: float, shape: Shape) -> tuple[float, float]:
    """Viscous friction forward and backward; one is 10 to 35 % of the other."""
    weak = size * (0.1 + 0.25 * shape["ratio"])
    return (size, weak) if _sign(shape) > 0 else (weak, size)


def _stribeck_numbers(size: float, shape: Shape, scales: Scales) -> tuple[float, float, float]:
    """Kinetic and static friction, and the speed between them."""
    return (0.4 + 0.25 * shape["ratio"]) * size, size, (0.08 + 0.15 * shape["speed"]) * scales["V"]


def _stribeck(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    """LuGre, beside the dry friction that the model knows of."""
    kinetic, static, speed = _stribeck_numbers(size, shape, scales)
    p["kinetic"][rows, joint], p["static"][rows, joint] = kinetic, static
    p["stribeck_speed"][rows, joint] = speed
    p["bristle"][rows, joint] = kinetic / (1.5e-4 * scales["top"])  # as stiff as the step allows at top speed
    p["bristle_damping"][rows, joint] = 0.4 * np.sqrt(p["bristle"][rows, joint] * scales["J"])


def _payload(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    p["payload"][rows] += size


def _tilt(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    p["tilt"][rows] += _sign(shape) * size


def _saturation(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    p["limit"][rows, joint] = (1 - size) * scales["peak"]


def _backlash(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    frequency, damping = TRANSMISSION
    inertia = p["armature"][rows, joint]
    p["elastic"][rows, joint], p["gap"][rows, joint] = 1.0, size
    p["stiffness"][rows, joint] = inertia * frequency**2
    p["twist_damping"][rows, joint] = 2 * damping * inertia * frequency


def _flexible(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    """Size is the twist [rad or m] under the typical force."""
    p["elastic"][rows, joint] = 1.0
    p["stiffness"][rows, joint] = scales["F"] / size
    p["twist_damping"][rows, joint] = 0.02 * np.sqrt(scales["F"] / size * p["armature"][rows, joint])


def _cogging(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    p["cog"][rows, joint], p["cog_period"][rows, joint] = size, (0.15 + 0.2 * shape["ratio"]) * scales["Q"]


def _wave(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    p["wave"][rows, joint], p["wave_period"][rows, joint] = size, (0.5 + 0.5 * shape["ratio"]) * scales["Q"]


def _drift(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    """The drive weakens as it warms up; over the whole recording it is as strong as the model says."""
    total = scales["seconds"]
    tau = (0.3 + 0.5 * shape["ratio"]) * total
    p["warmth"][rows], p["warmth_time"][rows] = size, tau
    p["warmth_mean"][rows] = tau / total * (1 - np.exp(-total / tau))


def _hysteresis(p: dict[str, Array], rows: Array, joint: int, size: float, shape: Shape, scales: Scales) -> None:
    p["hysteresis"][rows, joint] = size
    p["hysteresis_travel"][rows, joint] = (0.15 + 0.15 * shape["ratio"]) * scales["Q"]


def _named(name: str) -> Callable[[float, Shape, Scales], dict[str, float]]:
    return lambda size, shape, scales: {name: size}


def _named_signed(name: str, base: float = 0.0) -> Callable[[float, Shape, Scales], dict[str, float]]:
    return lambda size, shape, scales: {name: base + _sign(shape) * size}


def _nothing(size: float, shape: Shape, scales: Scales) -> dict[str, float]:
    return {}


def _of(share: float, expression: Callable[[Scales], float]) -> Callable[[Scales], float]:
    return lambda s: share * expression(s)


def _pair(
    expression: Callable[[Scales], float], guess: float, largest: float
) -> tuple[Callable[[Scales], float], Callable[[Scales], float]]:
    return _of(guess, expression), _of(largest, expression)


_f, _fv, _fvv = (lambda s: s["F"]), (lambda s: s["F"] / s["V"]), (lambda s: s["F"] / s["V"] ** 2)
_one, _q, _u = (lambda s: 1.0), (lambda s: s["Q"]), (lambda s: s["U"])

LIBRARY: dict[str, Entry] = {
    "viscous_friction": Entry("joint", *_pair(_fv, 0.02, 1), _add("b_pos", "b_neg"), _named("coefficient")),
    "coulomb_friction": Entry("joint", *_pair(_f, 0.02, 0.6), _add("c_pos", "c_neg"), _named("torque")),
    "asymmetric_friction": Entry(
        "joint",
        *_pair(_fv, 0.02, 1),
        _asymmetric,
        lambda size, shape, scales: dict(zip(("forward", "backward"), _directions(size, shape), strict=True)),
    ),
    "stribeck_friction": Entry(
        "joint",
        *_pair(_f, 0.02, 0.6),
        _stribeck,
        lambda size, shape, scales: dict(
            zip(("coulomb", "static", "velocity"), _stribeck_numbers(size, shape, scales), strict=True)
        ),
    ),
    "load_dependent_friction": Entry("joint", *_pair(_one, 0.02, 0.4), _add("load"), _named("coefficient")),
    "quadratic_drag": Entry("joint", *_pair(_fvv, 0.02, 1), _add("quad"), _named("coefficient")),
    "payload": Entry("body", *_pair(lambda s: s["M"], 0.02, 1), _payload, _named("mass")),
    "armature": Entry("joint", *_pair(lambda s: s["J"], 0.02, 1), _add("armature"), _named("inertia")),
    "actuator_gain": Entry("actuator", *_pair(_one, 0.01, 0.4), _signed("gain"), _named_signed("gain", 1.0)),
    "actuator_offset": Entry("actuator", *_pair(_u, 0.02, 0.6), _signed("offset"), _named_signed("offset")),
    "actuator_delay": Entry("actuator", *_pair(_one, 0.004, 0.05), _add("delay"), _named("delay"), SMALLEST_TIME),
    "actuator_lag": Entry("actuator", *_pair(_one, 0.004, 0.06), _add("lag"), _named("time_constant"), SMALLEST_TIME),
    "torque_saturation": Entry(
        "actuator",
        *_pair(_one, 0.2, 0.75),
        _saturation,
        lambda size, shape, scales: {"limit": (1 - size) * scales["peak"] / scales["gear"]},
        0.05,
    ),
    "deadband": Entry("actuator", *_pair(_u, 0.02, 0.6), _add("deadband"), _named("width")),
    "backlash": Entry("joint", *_pair(_q, 0.002, 0.08), _backlash, _named("gap")),
    "flexible_joint": Entry(
        "joint", *_pair(_q, 0.005, 0.08), _flexible, lambda size, shape, scales: {"compliance": size / scales["F"]}
    ),
    "joint_stiffness": Entry(
        "joint", *_pair(lambda s: s["F"] / s["Q"], 0.02, 1.5), _add("spring"), _named("stiffness")
    ),
    "gravity_tilt": Entry("scene", *_pair(_one, 0.01, 0.25), _tilt, _named_signed("angle")),
    "sensor_offset": Entry("signal", *_pair(_q, 0.02, 0.4), _signed("sensor_offset"), _named_signed("offset")),
    "sensor_gain": Entry("signal", *_pair(_one, 0.01, 0.15), _signed("sensor_gain"), _named_signed("gain", 1.0)),
    "sensor_delay": Entry("signal", *_pair(_one, 0.004, 0.05), _add("sensor_delay"), _named("delay"), SMALLEST_TIME),
}
OUTSIDE: dict[str, Entry] = {
    "cogging": Entry("joint", *_pair(_f, 0.05, 1), _cogging, _nothing),
    "position_dependent_friction": Entry("joint", *_pair(_one, 0.3, 0.95), _wave, _nothing, 0.3),
    "temperature_drift": Entry("scene", *_pair(_one, 0.05, 0.8), _drift, _nothing),
    "hysteresis": Entry("joint", *_pair(_f, 0.05, 0.8), _hysteresis, _nothing),
}
EVERYTHING = LIBRARY | OUTSIDE

_FRICTION = ("viscous_friction", "coulomb_friction", "asymmetric_friction", "stribeck_friction", "quadratic_drag")
_COMMAND = ("actuator_delay", "actuator_lag", "torque_saturation", "deadband")
_DRIVE = (*_COMMAND, "backlash", "flexible_joint", "joint_stiffness")
# Joints at which an effect leaves a trace of its own, so that data of this kind can name it (see `equivalents`).
SITES: dict[str, dict[str, tuple[int, ...]]] = {
    "slide": {name: (0,) for name in (*_FRICTION, *_DRIVE, "actuator_offset", "load_dependent_friction")},
    "pendulum": {
        name: (0,)
        for name in LIBRARY
        if name not in ("sensor_offset", "sensor_delay")  # near an offset and a tilt together, and equal to a delay
    },
    "arm": {name: (0, 1) for name in LIBRARY if name not in ("payload", "gravity_tilt")}
    | {"payload": (1,), "gravity_tilt": (0,)},
    "cartpole": {name: (0,) for name in (*_FRICTION, *_DRIVE, "actuator_gain", "actuator_offset", "armature")}
    | {name: (0, 1) for name in ("viscous_friction", "coulomb_friction", "quadratic_drag", "sensor_gain")}
    | {"payload": (1,), "gravity_tilt": (0,), "sensor_offset": (1,), "sensor_delay": (1,)},
}
OUTSIDE_SITES: dict[str, dict[str, tuple[int, ...]]] = {
    name: {effect: ((0, 1) if name == "arm" else (0,)) for effect in OUTSIDE} for name in PLANTS
}
_EVERY = tuple(range(7))
SITES["fr3"] = {name: _EVERY for name in ("viscous_friction", "coulomb_friction", "asymmetric_friction")}
SITES["fr3"] |= {name: _EVERY for name in ("actuator_gain", "actuator_offset", "actuator_delay", "sensor_offset")}
SITES["fr3"] |= {"payload": (6,), "armature": _EVERY, "joint_stiffness": _EVERY}
OUTSIDE_SITES["fr3"] = {name: _EVERY for name in ("cogging", "position_dependent_friction")}


def equivalents(plant: str, effects: Mapping[str, int], force_measured: bool) -> list[list[str]]:
    """Other sets of names whose data are exactly the same, by the equations of motion; of effects at joints.

    On one joint without gravity a tilt and an offset of the command are the same constant force, and a payload is an
    armature. With one actuator a delay of the command is a delay of everything that is measured. The measured force of
    the drive tells apart what the command does from what comes after. On the cart an armature is a heavier cart. An
    encoder's offset at the arm's shoulder turns the whole arm, and so does a tilt.
    On the FR3, whose weight is compensated, an encoder that reads too much, or by a factor, shows what a servo does
    whose command is shifted or scaled, but for what a milliradian changes of the arm's inertia.
    """
    swaps: dict[str, list[str]] = {"cartpole": {"armature": ["payload"]}}.get(plant, {})
    if plant == "fr3":
        swaps = {"actuator_offset": ["sensor_offset"], "sensor_offset": ["actuator_offset"]}
        swaps |= {"actuator_gain": ["sensor_gain"]}
    if plant == "arm":
        swaps = {"gravity_tilt": ["sensor_offset"]}
        if effects.get("sensor_offset") == 0:
            swaps["sensor_offset"] = ["gravity_tilt"]
    if plant == "slide":
        swaps = {"payload": ["armature"], "armature": ["payload"]}
        if not force_measured:
            swaps |= {"actuator_offset": ["gravity_tilt"], "gravity_tilt": ["actuator_offset"]}
    if plant in ("slide", "pendulum") and not force_measured:
        swaps |= {"actuator_delay": ["sensor_delay"], "sensor_delay": ["actuator_delay"]}
    return [
        sorted(other if name == old else name for name in effects)
        for old in effects
        for other in swaps.get(old, [])
        if other not in effects
    ]


def place(plant: Machine, effect: str, joint: int) -> list[str]:
    """Names of the elements at which an effect sits, [] for the whole scene."""
    sits = EVERYTHING[effect].sits
    if sits == "scene":
        return []
    if sits == "body":
        return [plant.tip]
    if sits == "signal":
        return [f"qpos/{plant.joints[joint]}"]
    return [plant.actuators[joint]] if sits == "actuator" else [plant.joints[joint]]
