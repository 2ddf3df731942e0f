"""What a report says in plain words: one sentence for each effect, and the headline."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mpc_sgft.diagnose.candidates.effect_facts import effect_class

Row = Mapping[str, Any]

SAYS: dict[str, Callable[[str, dict[str, float], Callable[[str], str]], str]] = {
    "viscous_friction": lambda at, x, u: f"{at} has {u('coefficient')} {_more(x['coefficient'])} viscous friction",
    "coulomb_friction": lambda at, x, u: f"{at} has {u('torque')} {_more(x['torque'])} dry friction",
    "asymmetric_friction": lambda at, x, u: (
        f"{at} has other viscous friction forward ({u('forward')}) than backward ({u('backward')})"
    ),
    "stribeck_friction": lambda at, x, u: (
        f"{at} sticks: dry friction of {u('static')} at rest falls to {u('coulomb')} in motion"
    ),
    "load_dependent_friction": lambda at, x, u: f"friction of {at} grows with its load, by {u('coefficient')} of it",
    "quadratic_drag": lambda at, x, u: f"{at} has {u('coefficient')} {_more(x['coefficient'])} quadratic drag",
    "joint_stiffness": lambda at, x, u: f"a spring of {u('stiffness')} pulls {at} towards {u('rest')}",
    "armature": lambda at, x, u: f"the rotor of {at} has {u('inertia')} {_more(x['inertia'])} inertia",
    "backlash": lambda at, x, u: f"the drive of {at} has a play of {u('gap')}",
    "flexible_joint": lambda at, x, u: f"the drive of {at} is elastic: it gives way by {u('compliance')}",
    "gravity_tilt": lambda at, x, u: f"the base is tilted by {u('angle')} and rolled by {u('roll')}",
    "payload": lambda at, x, u: f"{at} carries {u('mass')} {'more' if x['mass'] >= 0 else 'less'}",
    "contact_friction": lambda at, x, u: f"{at} slides with a friction coefficient of {x['coefficient']:.3g}",
    "contact_softness": lambda at, x, u: f"contacts of {at} are softer: a time constant of {u('time_constant')}",
    "actuator_gain": lambda at, x, u: f"{at} exerts {x['gain']:.4g} times the force that it is asked for",
    "actuator_offset": lambda at, x, u: f"the command of {at} arrives with {x['offset']:.3g} added to it",
    "deadband": lambda at, x, u: f"{at} does nothing for commands smaller than {x['width']:.3g}",
    "torque_saturation": lambda at, x, u: f"{at} never exerts more than {u('limit')}",
    "actuator_delay": lambda at, x, u: f"commands of {at} arrive {u('delay')} late",
    "actuator_lag": lambda at, x, u: f"{at} follows its command with a time constant of {u('time_constant')}",
    "sensor_gain": lambda at, x, u: f"{at} reads {x['gain']:.4g} times the truth",
    "sensor_offset": lambda at, x, u: f"{at} reads {u('offset')} too {'much' if x['offset'] >= 0 else 'little'}",
    "sensor_delay": lambda at, x, u: f"{at} is read {u('delay')} late",
    "frame_rotation": lambda at, x, u: f"the frame of the {at} is turned by {u('angle')}",
}


def sentence(effect: Row) -> str:
    """What one effect of report.json means for the machine, "than the model says" left out."""
    values = {name: float(p["value"]) for name, p in effect["parameters"].items()}
    at = place(effect)

    def with_unit(name: str, *, signed: bool = False) -> str:
        unit = effect["parameters"][name]["unit"].split(" or ")
        amount = values[name] if signed or name in ("rest", "angle", "roll") else abs(values[name])
        return f"{amount:.3g} {unit[0] if len(unit) == 1 else '/'.join(unit)}".removesuffix(" 1")

    def plain() -> str:
        parts = ", ".join(f"{n} {with_unit(n, signed=True)}" for n in values)
        return f"{effect['name'].replace('_', ' ')} at {at}: {parts}"

    says = SAYS.get(effect["name"])
    if says is None or not set(values):
        return plain()
    try:
        return says(at, values, with_unit)
    except KeyError:  # an effect's parameter that is held is in no row
        return plain()


def place(effect: Row) -> str:
    """Where an effect is, such as "joint elbow"."""
    names, kind = ", ".join(effect["at"]), effect_class(effect["name"]).place
    if not names:
        return f"every {kind}" if kind in ("joint", "actuator") else "the scene"
    if kind not in ("joint", "actuator", "body"):
        return names
    return f"{kind} {names}" if len(effect["at"]) == 1 else f"each of the {kind}s {names}"


def changes(effect: Row) -> list[str]:
    """By how much predictions move without an effect: the signals that move most."""
    moved = sorted((c for c in effect["changes"] if c["rms"]), key=lambda c: -c["rms"])
    return [f"{c['signal']} by {c['rms']:.2g} {c['unit']}" for c in moved[:3]]


def headline(report: Row) -> str:
    """The answer in one or two sentences, for the head of the page and the terminal."""
    kind, h = report["verdict"], report["held_out"]
    error = f"{h['nominal']:.3g} {h['unit']} of {h['signal']}"
    if kind == "none":
        unexplained = report["reason"].startswith("no name")  # the error may be large: it is not said to be nothing
        lead = "Nothing is named" if unexplained else "Nothing that matters is missing"
        return f"{lead}: {report['reason']} ({error})."
    if kind == "unknown":
        return f"Something is missing that no name in the library covers: {report['reason']}."
    said = "The model lacks this: " + "; ".join(sentence(e) for e in report["effects"])
    if kind == "not_identifiable":
        rivals = " or ".join(" + ".join(t["effects"]) for t in report["ties"])
        return f"{said}. Or it is {rivals}: these data cannot tell."
    fell = f"from {h['nominal']:.3g} to {h['repaired']:.3g} {h['unit']}"
    return f"{said}. With that in it, the error of {h['signal']} falls {fell}."


def _more(x: float) -> str:
    return "more" if x >= 0 else "less"
