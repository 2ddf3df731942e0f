"""Nominal quantities that the user calls uncertain: refitted in the baseline and in every candidate."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from mpc_sgft.command.errors import UserError, unknown
from mpc_sgft.diagnose.candidates.library import Term
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.simulation.plant import Change, Plant

QUANTITIES = ("mass", "gain", "length", "inertia", "armature", "damping")


def nominal_terms(plant: Plant, uncertain: Mapping[str, float]) -> list[Term]:
    """One scale factor for each quantity at each body, actuator or joint, 1 at the nominal value.

    Args:
        plant: The nominal scene.
        uncertain: Quantity -> share by which the nominal value may be wrong, such as {"mass": 0.3}.

    Raises:
        UserError: For an unknown quantity or a share that is not between 0 and 1.
    """
    built = []
    for name, share in uncertain.items():
        if name not in QUANTITIES:
            raise unknown("uncertain quantity", name, QUANTITIES)
        if not 0 < share < 1:
            raise UserError(f"uncertain {name}={share}: a share between 0 and 1, such as 0.3 for 30 %")
        for place in _places(plant, name):
            built.append(_term(plant, name, place, share))
    return built


def _places(plant: Plant, name: str) -> list[str]:
    m = plant.model
    if name == "gain":
        return plant.actuators
    if name in ("armature", "damping"):
        values = m.dof_armature if name == "armature" else m.dof_damping
        return [j for i, j in enumerate(plant.joints) if values[i] > 0]
    if name == "length":
        return [b for b in plant.bodies if np.abs(m.body_ipos[m.body(b).id]).max() > 1e-9]
    if name == "inertia":
        return [b for b in plant.bodies if (m.jnt_type[m.body_jntadr[m.body(b).id]] == mujoco.mjtJoint.mjJNT_HINGE)]
    return plant.bodies


def _term(plant: Plant, name: str, place: str, share: float) -> Term:
    one = np.ones(1)
    return Term(
        effect="nominal",
        at=(place,),
        names=(name,),
        units=("of nominal",),
        neutral=one,
        low=one * (1 - share),
        high=one * (1 + share),
        size=one * share / 2,
        starts=(one,),
        build=lambda values: Change(edits=(lambda spec: scale(spec, plant, name, place, float(values[0])),)),
    )


def scale(spec: mujoco.MjSpec, plant: Plant, name: str, place: str, factor: float) -> None:
    """Multiply one nominal quantity of a scene; mass takes the body's inertia with it, length its centre of mass."""
    if name == "gain":
        actuator = spec.actuator(place)
        actuator.gainprm[:3] = np.array(actuator.gainprm[:3]) * factor
        actuator.biasprm[:3] = np.array(actuator.biasprm[:3]) * factor
    elif name == "armature":
        spec.joint(place).armature = spec.joint(place).armature * factor
    elif name == "damping":
        joint = spec.joint(place)
        joint.damping[:] = np.array(joint.damping) * factor
    else:
        _inertial(spec, plant, name, place, factor)


def _inertial(spec: mujoco.MjSpec, plant: Plant, name: str, place: str, factor: float) -> None:
    """Write the compiled inertia of a body explicitly, with one of its numbers scaled.

    What other effects add to the body sits in bodies of its own and stays as it is.
    """
    m, body = plant.model, spec.body(place)
    i = m.body(place).id
    mass, position, inertia = float(m.body_mass[i]), np.array(m.body_ipos[i]), np.array(m.body_inertia[i])
    if body.explicitinertial and np.isnan(body.fullinertia[0]):  # also if another quantity of it was scaled before
        mass, position, inertia = float(body.mass), np.array(body.ipos), np.array(body.inertia)
    if name == "mass":
        mass, inertia = mass * factor, inertia * factor
    elif name == "inertia":
        inertia = inertia * factor
    else:
        position = position * factor
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat, body.inertia = mass, position, m.body_iquat[i], inertia
    body.fullinertia[0] = np.nan


def refit_table(terms: list[Term], values: list[Array]) -> dict[str, dict[str, float]]:
    """What the report says about nominal quantities: {"mass carriage": {"factor", "allowed_low", "allowed_high"}}."""
    return {
        f"{t.names[0]} {t.at[0]}": {
            "factor": float(v[0]),
            "allowed_low": float(t.low[0]),
            "allowed_high": float(t.high[0]),
        }
        for t, v in zip(terms, values, strict=True)
    }
