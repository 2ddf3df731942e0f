"""Where a window begins, what no sensor shows: how rotors lean and twist, and how bristles are bent."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mpc_sgft.diagnose.candidates.effect_table import TypicalSizes
from mpc_sgft.diagnose.candidates.library import make_term
from mpc_sgft.diagnose.data.measured import Episode
from mpc_sgft.diagnose.fitting.prepare import typical_sizes
from mpc_sgft.diagnose.simulation.plant import Change, Plant
from mpc_sgft.diagnose.simulation.replay import Replayer

SLIDE = """<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"
armature="{}"/><geom size="0.1" mass="2"/></body></worldbody>
<actuator><motor name="motor" joint="x"/></actuator></mujoco>"""


def _window_errors(plant: Plant, change: Change, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors at the ends of windows of a motion that this change made, [W]: led to each window, and not."""
    m, q = plant.compile(change), []
    data = mujoco.MjData(m)
    for command in u:
        q.append(data.qpos[0])
        data.ctrl[0] = command
        mujoco.mj_step(m, data)
    replayer = Replayer(plant, [Episode("a", 0.002, u[:, None], {"qpos/x": np.array(q)})], 0.3, ["qpos/x"])
    led = np.abs(replayer.simulate([change])[0] - replayer.windows.measured)[1:, -1, 0]
    replayer.ahead = np.zeros_like(replayer.ahead)
    return led, np.abs(replayer.simulate([change])[0] - replayer.windows.measured)[1:, -1, 0]


def test_rotors_come_to_the_window_as_the_motion_before_left_them() -> None:
    """Within the play nothing pushes the joint, so that its acceleration does not tell where the rotor is."""
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.format(0.5)))
    play = make_term(plant, "backlash", "x", TypicalSizes()).build(np.array([0.02]))
    led, guessed = _window_errors(plant, play, 4 * np.cos(3 * 0.002 * np.arange(3000)))
    assert (guessed > 3e-3).sum() > 2 > (led > 2e-3).sum() and led.mean() < 0.4 * guessed.mean()


def test_a_window_begins_with_an_elastic_drive_that_rings() -> None:
    """How the joint's acceleration changes tells how fast the drive twists; without it the window begins at rest."""
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.format(0.5)))
    spring = make_term(plant, "flexible_joint", "x", TypicalSizes()).build(np.array([1 / 300]))
    u = 4 * np.sign(np.cos(3 * 0.002 * np.arange(3000)))
    led, guessed = _window_errors(plant, spring, u)
    assert led.mean() < 1e-3 and guessed.mean() < 2e-3  # 13e-3 by whoever begins without a twist that changes


def test_bristles_come_to_the_window_as_the_motion_before_bent_them() -> None:
    """Where a joint hardly moves, its speed does not tell how far its bristles are bent."""
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.format(0)))
    numbers = np.array([1.0, 0.5, 0.05, 0.01, 0.3])  # coulomb, excess, velocity, deflection, damping ratio
    lugre = make_term(plant, "stribeck_friction", "x", TypicalSizes()).build(numbers)
    led, guessed = _window_errors(plant, lugre, 2 * np.cos(3 * 0.002 * np.arange(3000)))
    assert np.median(led) < 1e-3 and led.mean() < 0.4 * guessed.mean()


FILTER = 'general name="motor" joint="x" dyntype="filterexact" dynprm="0.1"'
DELAY = 'general name="motor" joint="x" delay="0.05" nsample="30"'


def test_a_window_begins_with_what_a_filter_made_of_the_commands_before() -> None:
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.format(0).replace('motor name="motor" joint="x"', FILTER)))
    u = 4 * np.sign(np.cos(3 * 0.002 * np.arange(3000)))
    errors, _ = _window_errors(plant, Change(), u)
    assert errors[1:].max() < 1e-3  # the first one began with the recording, at rest


@pytest.mark.parametrize("actuator", [FILTER, DELAY])
def test_a_filter_and_a_delay_leave_an_actuator_its_force(actuator: str) -> None:
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.format(0).replace('motor name="motor" joint="x"', actuator)))
    t = 0.002 * np.arange(1000)
    episode = Episode("a", 0.002, 4 * np.cos(3 * t)[:, None], {"qpos/x": 0.1 * np.cos(3 * t)})
    sizes = typical_sizes(plant, Replayer(plant, [episode], 0.3, ["qpos/x"]))
    assert sizes["actuator", "motor"].peak == pytest.approx(4, rel=0.01)
    told = plant.notes_of_delays()
    assert not told if actuator == FILTER else told[0].startswith("motor: the model delays its command")
