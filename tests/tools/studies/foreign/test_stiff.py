"""The stiff engine obeys mechanics, is what its MJCF says, and its dry friction holds."""

import mujoco
import numpy as np
import pytest
from scipy.special import ellipk

from tests.tools.studies.foreign.machines import DT, beside_mujoco, energies, machine, run
from tools.studies.foreign.scenes import build, parameters
from tools.studies.foreign.stiff import CREEP, Stiff

NAMES = ("screw", "slide", "servo", "pendulum", "arm")


@pytest.mark.parametrize("name", NAMES)
def test_nominal_machines_agree_with_mujoco_on_their_mjcf(name: str) -> None:
    record, worst = beside_mujoco(Stiff, name, 400)
    assert np.ptp(record.q, 0).min() > 0.01 and worst.max() < 2e-5


def test_a_free_pendulum_has_the_exact_period() -> None:
    scene, numbers = machine("pendulum", damping=[0.0])
    record = run(Stiff, scene, numbers, [1.0], [0.0], 1500)
    m, c, i, armature = (numbers[k][0] for k in ("m", "c", "i", "armature"))
    period = 4 * np.sqrt((i + m * c * c + armature) / (m * 9.81 * c)) * ellipk(np.sin(0.5) ** 2)
    q = record.q[:, 0]
    falls = np.flatnonzero((q[:-1] > 0) & (q[1:] <= 0))
    times = DT * (falls + q[falls] / (q[falls] - q[falls + 1]))
    assert np.allclose(np.diff(times), period, rtol=1e-5)


def test_an_arm_without_friction_keeps_its_energy() -> None:
    scene, numbers = machine("arm", damping=[0.0, 0.0])
    record = run(Stiff, scene, numbers, [1.0, -0.5], [0.0, 0.0], 1000)
    energy = energies(scene, numbers, record, (0, 400, 999))
    total = energy.sum(1)
    assert np.ptp(total) < 1e-4 * abs(total[0])


def test_payload_and_tilt_mean_what_mujoco_means() -> None:
    scene, numbers = machine("arm")
    spec = mujoco.MjSpec.from_string(build(scene, numbers))
    load = spec.body(scene.tip).add_body(pos=[0, 0, -numbers["l"][1]])
    load.mass, load.inertia, load.ipos, load.explicitinertial = 0.3, [1e-12] * 3, [0, 0, 0], True
    spec.option.gravity = [9.81 * np.sin(0.2), 0, -9.81 * np.cos(0.2)]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.5, 0.8], [1.0, -2.0]
    mujoco.mj_forward(model, data)
    p = parameters(scene, numbers)
    p["payload"][:], p["tilt"][:] = 0.3, 0.2
    engine = Stiff(scene, p)
    engine.reset(data.qpos, data.qvel, np.zeros(2))
    assert np.allclose(engine._slope(0.0, engine.y)[2:], data.qacc, rtol=1e-7)


def test_dry_friction_holds_below_its_level_and_lets_go_above() -> None:
    scene, numbers = machine("slide", gear=[10.0], damping=[0.0])
    held, moving = (
        run(Stiff, scene, numbers, [0.1], [0.0], 500, np.full((500, 1), u), c_pos=5.0, c_neg=5.0) for u in (0.49, 0.6)
    )
    assert abs(held.q[-1, 0] - 0.1) < 3 * CREEP["slide"]  # [m] in 1 s
    mass = numbers["m"][0] + numbers["armature"][0]
    assert moving.v[-1, 0] == pytest.approx((6.0 - 5.0) / mass * 499 * DT, rel=1e-3)


def test_a_sliding_table_stops_where_its_kinetic_energy_is_used_up() -> None:
    scene, numbers = machine("slide", damping=[0.0])
    mass = numbers["m"][0] + numbers["armature"][0]
    record = run(Stiff, scene, numbers, [0.0], [0.3], 1000, c_pos=2.0, c_neg=2.0)
    assert record.q[-1, 0] == pytest.approx(0.5 * mass * 0.3**2 / 2.0, rel=1e-3)
    assert abs(record.v[-1, 0]) < CREEP["slide"]


def test_a_lag_is_exact_and_a_limit_holds() -> None:
    scene, numbers = machine("slide", gear=[10.0], damping=[0.0])
    commands = np.r_[np.zeros(1), np.ones(199)][:, None]
    record = run(Stiff, scene, numbers, [0.0], [0.0], 200, commands, lag=0.02)
    assert np.allclose(record.force[1:, 0], 10 * (1 - np.exp(-DT * np.arange(199) / 0.02)))
    assert np.allclose(run(Stiff, scene, numbers, [0.0], [0.0], 200, commands, limit=4.0).force[1:], 4.0)


def test_a_rotor_crosses_the_play_alone() -> None:
    scene, numbers = machine("slide", gear=[10.0], damping=[0.0], armature=[1.0])
    p = {"elastic": 1.0, "gap": 1e-3, "stiffness": 4e6, "twist_damping": 1200.0}
    record = run(Stiff, scene, numbers, [0.0], [0.0], 60, np.full((60, 1), 0.1), **p)
    touch = int(np.sqrt(2e-3) / DT)  # 1 N on 1 kg: 1 mm takes 45 ms
    assert np.all(record.q[: touch - 1, 0] == 0.0) and record.q[-1, 0] > 1e-5
