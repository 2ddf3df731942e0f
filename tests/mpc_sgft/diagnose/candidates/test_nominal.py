"""Quantities of the model that a user calls uncertain, scaled as its own compiler has them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.nominal import scale
from mpc_sgft.diagnose.simulation.plant import Plant

INERTIALS = {
    "of the geoms": "",
    "diagonal": '<inertial pos="0 0 -0.2" mass="2" diaginertia="0.03 0.03 0.02"/>',
    "full, as CAD programs write it": '<inertial pos="0 0 -0.2" mass="2" fullinertia="0.03 0.03 0.02 0.001 0 0.002"/>',
}


@pytest.mark.parametrize("inertial", INERTIALS.values(), ids=list(INERTIALS))
def test_two_quantities_of_a_body_are_scaled_one_after_the_other(inertial: str) -> None:
    scene = f"""<mujoco><worldbody><body name="arm"><joint name="j" axis="0 1 0"/>{inertial}
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1"/></body></worldbody></mujoco>"""
    plant = Plant(mujoco.MjSpec.from_string(scene))
    spec = plant.spec.copy()
    scale(spec, plant, "mass", "arm", 1.5)  # takes the inertia with it
    scale(spec, plant, "inertia", "arm", 2.0)
    before, after, arm = plant.model, spec.compile(), plant.model.body("arm").id
    assert after.body_mass[arm] == pytest.approx(1.5 * before.body_mass[arm])
    np.testing.assert_allclose(after.body_inertia[arm], 3 * before.body_inertia[arm])
    np.testing.assert_allclose(after.body_iquat[arm], before.body_iquat[arm])
