"""PyBullet's machines obey mechanics, are what their MJCF says but for the error of their steps, and truly stick."""

import numpy as np
import pytest

from tests.tools.studies.foreign.machines import DT, beside_mujoco, energies, machine, run
from tools.studies.blind.library import LIBRARY
from tools.studies.foreign.loop import simulate
from tools.studies.foreign.scenes import parameters
from tools.studies.foreign.stiff import Stiff

pytest.importorskip("pybullet", reason="needs PyBullet")
from tools.studies.foreign.bullet import STEP, Bullet  # noqa: E402

NAMES = ("slide", "pendulum", "arm", "cartpole", "arm3")


@pytest.mark.parametrize("name", NAMES)
def test_nominal_machines_agree_with_mujoco_within_a_few_steps(name: str) -> None:
    record, worst = beside_mujoco(Bullet, name, 250)
    assert np.all(worst < 1e-3 * np.ptp(record.q, 0))  # a tenth of what matters, over the longest half window
    assert np.all(worst < 10 * STEP * np.abs(record.v).max())


def test_the_error_of_a_free_pendulum_is_first_order_in_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, numbers = machine("pendulum", damping=[0.0])
    exact = run(Stiff, scene, numbers, [1.0], [0.0], 1000).q
    errors = []
    for step in (STEP, 4 * STEP):
        monkeypatch.setattr("tools.studies.foreign.bullet.STEP", step)
        errors.append(np.sqrt(np.mean((run(Bullet, scene, numbers, [1.0], [0.0], 1000).q - exact) ** 2)))
    assert 3.0 < errors[1] / errors[0] < 5.0
    assert errors[0] < 2.5e-4 * exact.std()  # over 2 s; 1 % matters


def test_an_arm_without_friction_keeps_its_energy() -> None:
    scene, numbers = machine("arm", damping=[0.0, 0.0])
    record = run(Bullet, scene, numbers, [1.0, -0.5], [0.0, 0.0], 1000)
    energy = energies(scene, numbers, record, (0, 400, 999))
    assert np.ptp(np.sum(energy, 1)) < 2e-3 * np.ptp(energy, 0)[1]


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("pendulum", {"b_pos": 0.1, "b_neg": 0.1}),
        ("pendulum", {"payload": 0.2, "tilt": 0.1}),
        ("pendulum", {"b_pos": 0.2, "quad": 0.05}),
        ("slide", {"spring": 30.0, "rest": 0.05, "warmth": 0.3, "cog": 1.0, "cog_period": 0.05}),
        ("slide", {"lag": 0.02, "limit": 2.0}),
        ("pendulum", {"c_pos": 0.1, "c_neg": 0.1}),
        ("slide", {"kinetic": 1.0, "static": 2.0, "stribeck_speed": 0.05}),
        ("slide", {"load": 0.2}),
        ("pendulum", {"elastic": 1.0, "stiffness": 40.0, "twist_damping": 0.02}),
        ("pendulum", {"elastic": 1.0, "stiffness": 5.0, "twist_damping": 0.02, "b_pos": 0.1, "b_neg": 0.1}),
        ("slide", {"elastic": 1.0, "stiffness": 300.0, "twist_damping": 1.0, "b_pos": 20.0, "b_neg": 20.0}),
    ],
)
def test_effects_do_what_they_do_in_the_other_engine(name: str, effects: dict[str, float]) -> None:
    scene, numbers = machine(name, damping=[0.0])
    commands = 0.4 * np.sin(0.02 * np.arange(500))[:, None]
    start = [0.1], [0.0], 500, commands
    one, two = (run(engine, scene, numbers, *start, **effects).q for engine in (Bullet, Stiff))
    change = np.sqrt(np.mean((two - run(Stiff, scene, numbers, *start).q) ** 2))
    assert change > 1e-3 and np.sqrt(np.mean((one - two) ** 2)) < 0.03 * change


@pytest.mark.parametrize("name", ["slide", "pendulum", "arm"])
def test_play_does_about_what_a_hard_spring_behind_it_does(name: str) -> None:
    """The rest is the law of impact, each engine's own."""
    scene, numbers = machine(name)
    p, start = parameters(scene, numbers), (np.zeros(scene.n), np.zeros(scene.n))
    commands = 0.2 * np.sin(0.03 * np.arange(500)[:, None] + np.arange(len(scene.actuators)))
    base = simulate(Stiff(scene, p), p, start, 500, DT, commands).q
    LIBRARY["backlash"].apply(p, np.array([0]), 0, 0.05 * np.ptp(base[:, 0]), {}, {})
    one, two = (simulate(engine(scene, p), p, start, 500, DT, commands).q for engine in (Bullet, Stiff))
    assert np.sqrt(np.mean((one - two) ** 2)) < 0.13 * np.sqrt(np.mean((two - base) ** 2))


def test_dry_friction_holds_exactly_below_its_level_and_lets_go_above() -> None:
    scene, numbers = machine("slide", gear=[10.0], damping=[0.0])
    held, moving = (
        run(Bullet, scene, numbers, [0.1], [0.0], 500, np.full((500, 1), u), c_pos=5.0, c_neg=5.0) for u in (0.49, 0.6)
    )
    assert abs(held.q[-1, 0] - 0.1) < 1e-9 and abs(held.v[-1, 0]) < 1e-9
    mass = numbers["m"][0] + numbers["armature"][0]
    assert moving.v[-1, 0] == pytest.approx((6.0 - 5.0) / mass * 499 * DT, rel=1e-3)


def test_limits_of_a_joint_are_the_play_of_a_gear() -> None:
    scene, numbers = machine("slide", gear=[10.0], damping=[0.0], armature=[1.0])
    back_and_forth = 0.5 * np.sign(np.sin(0.05 * np.arange(400)))[:, None]
    p = parameters(scene, numbers)
    p["elastic"][:], p["gap"][:] = 1.0, 1e-3
    engine, twist = Bullet(scene, p), []

    def watch(k: int, read: np.ndarray) -> np.ndarray:
        twist.append(engine.states[1][0])
        return back_and_forth[k]

    simulate(engine, p, (np.zeros(1), np.zeros(1)), 400, DT, watch)
    assert 0.95e-3 < max(twist) < 1.1e-3 and -1.1e-3 < min(twist) < -0.95e-3
