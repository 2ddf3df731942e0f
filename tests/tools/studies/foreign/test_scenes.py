"""Every machine compiles, and cases come from the seed alone."""

from collections import Counter

import mujoco
import numpy as np
import pytest

from tools.studies.blind.draw import FRICTION_PAIRS
from tools.studies.blind.library import LIBRARY, OUTSIDE
from tools.studies.foreign.draw import FELT, draw, redraw
from tools.studies.foreign.grounds import MIX
from tools.studies.foreign.scenes import SCENES, build, draw_nominal, parameters

EVERY = dict.fromkeys(SCENES, 1.0)


@pytest.mark.parametrize("name", SCENES)
def test_the_nominal_model_is_what_the_numbers_say(name: str) -> None:
    scene = SCENES[name]
    numbers = draw_nominal(scene, np.random.default_rng(0))
    model = mujoco.MjModel.from_xml_string(build(scene, numbers))
    assert [model.joint(j).name for j in range(model.njnt)] == list(scene.joints)
    assert [model.actuator(a).name for a in range(model.nu)] == list(scene.actuators)
    assert np.allclose(model.dof_armature, numbers["armature"]) and np.allclose(model.dof_damping, numbers["damping"])
    assert np.allclose(model.body_mass[1:], numbers["m"]) and model.body(model.nbody - 1).name == scene.tip
    p = parameters(scene, numbers)
    assert np.allclose(p["b_pos"][0], numbers["damping"]) and np.allclose(p["c_neg"][0], numbers["dry"])


@pytest.mark.parametrize("name", SCENES)
def test_effects_sit_where_there_is_something_to_sit_on(name: str) -> None:
    scene = SCENES[name]
    assert set(scene.sites) <= set(LIBRARY) and set(scene.outside) <= set(OUTSIDE)
    for effect, joints in (scene.sites | scene.outside).items():
        assert max(joints) < (
            len(scene.actuators) if LIBRARY.get(effect, OUTSIDE.get(effect)).sits == "actuator" else scene.n
        )


def test_a_seed_gives_the_same_cases_and_another_gives_others() -> None:
    assert draw(5, 40, EVERY, MIX) == draw(5, 40, EVERY, MIX) != draw(6, 40, EVERY, MIX)
    case = draw(5, 1, EVERY, MIX)[0]
    assert redraw(case.entropy, case.group, EVERY, MIX) == case != redraw(case.entropy, case.group, EVERY, MIX, 1)


def test_another_case_outside_has_another_effect() -> None:
    """On some machines one of them never matters for certain: it would be drawn for hours, and end in an error."""
    for case in (c for c in draw(5, 100, EVERY, MIX) if c.group == "outside"):
        again = [redraw(case.entropy, case.group, EVERY, MIX, k).effects[0].name for k in range(6)]
        assert len(set(again)) > 1, again


def test_shares_sizes_and_what_free_swings_show() -> None:
    drawn = draw(5, 200, EVERY, MIX)
    assert Counter(c.group for c in drawn) == {"single": 100, "pair": 40, "none": 30, "outside": 30}
    assert all(3.0 <= e.multiple <= 20.0 for c in drawn for e in c.effects)
    assert all(2 <= len(c.seconds) <= 4 and 4.0 <= min(c.seconds) and max(c.seconds) <= 8.0 for c in drawn)
    swings = [c for c in drawn if c.swings]
    assert swings and all({e.name for e in c.effects} <= FELT and not c.force_channel for c in swings)
    pairs = [{e.name for e in c.effects} for c in drawn if c.group == "pair"]
    viscous = {"viscous_friction", "asymmetric_friction", "coulomb_friction", "stribeck_friction"}
    assert all(len(p) == 2 and (len(p & viscous) < 2 or p in FRICTION_PAIRS) for p in pairs)


def test_where_an_effect_needs_it_the_machine_has_it() -> None:
    for case in draw(5, 200, EVERY, MIX):
        names = {e.name for e in case.effects}
        assert case.nominal["dry"][0] > 0 or "position_dependent_friction" not in names
        assert case.nominal["dry"][0] == 0 or not names & {"backlash", "flexible_joint"}
