"""The plants obey the laws of mechanics, and are what their MJCF says."""

import mujoco
import numpy as np
import pytest

from tools.studies.blind.integrate import Integrator, start
from tools.studies.blind.loop import H
from tools.studies.blind.mjcf import build, draw_nominal
from tools.studies.blind.plants import PLANTS, Plant, prepare
from tools.studies.blind.truths import rows

Q, V = np.array([[0.3, 0.8]]), np.array([[0.4, -1.5]])


def nominal(plant: Plant, *, damping: bool = False) -> dict:
    numbers = draw_nominal(plant, np.random.default_rng(1)) | {"dry": [0.0] * plant.n}
    return numbers if damping else numbers | {"damping": [0.0] * plant.n}


@pytest.mark.parametrize("name", PLANTS)
def test_energy_is_conserved_without_friction_and_drive(name: str) -> None:
    plant = PLANTS[name]
    numbers = nominal(plant) | {"kp": [0.0], "kv": [0.0]}
    p = rows(plant, numbers)
    p["tilt"][:] = 0.1
    state, integrator = start(Q[:, : plant.n], V[:, : plant.n]), Integrator(plant, p, H)
    before, off = plant.energy(state.y[0], state.y[1], p)[0], np.zeros((1, plant.n))
    for k in range(2500):
        state = integrator.step(state, (off, off, off), k * H)
    assert not np.allclose(state.y[0], Q[:, : plant.n], atol=0.05)  # it did move
    assert abs(plant.energy(state.y[0], state.y[1], p)[0] - before) < 1e-9 * max(abs(before), 1)


def test_a_free_cart_and_its_pole_keep_their_horizontal_momentum() -> None:
    plant = PLANTS["cartpole"]
    p = rows(plant, nominal(plant))
    state, integrator, off = start(Q, V), Integrator(plant, p, H), np.zeros((1, 2))

    def momentum() -> float:
        return float(np.einsum("rij,rj->ri", plant.mass(state.y[0], p), state.y[1])[0, 0])

    before = momentum()
    for k in range(2000):
        state = integrator.step(state, (off, off, off), k * H)
    assert abs(momentum() - before) < 1e-10


@pytest.mark.parametrize("name", PLANTS)
def test_nominal_plants_agree_with_mujoco_on_their_mjcf(name: str) -> None:
    plant = PLANTS[name]
    numbers = nominal(plant, damping=True)
    model = mujoco.MjModel.from_xml_string(build(plant, numbers, timestep=H))
    data = mujoco.MjData(model)
    data.qpos, data.qvel = Q[0, : plant.n], V[0, : plant.n]
    state, integrator = start(Q[:, : plant.n], V[:, : plant.n]), Integrator(plant, rows(plant, numbers), H)
    worst, command = 0.0, np.zeros((1, plant.n))
    for k in range(2500):
        command[0, : model.nu] = 0.4 * np.sin(5 * H * k + np.arange(model.nu))
        data.ctrl = command[0, : model.nu]
        mujoco.mj_step(model, data)
        state = integrator.step(state, (command, command, command), k * H)
        worst = max(worst, float(np.abs(data.qpos - state.y[0, 0]).max()))
    assert worst < 1e-7


@pytest.mark.parametrize("name", ["pendulum", "arm", "cartpole"])
def test_payload_and_tilt_mean_what_mujoco_means(name: str) -> None:
    plant = PLANTS[name]
    numbers = nominal(plant, damping=True)
    spec = mujoco.MjSpec.from_string(build(plant, numbers, timestep=H))
    end = numbers["l2"] if "l2" in numbers else numbers["l"]
    load = spec.body(plant.tip).add_body(pos=[0, 0, -end])
    load.mass, load.inertia, load.ipos, load.explicitinertial = 0.3, [1e-12] * 3, [0, 0, 0], True
    spec.option.gravity = [9.81 * np.sin(0.2), 0, -9.81 * np.cos(0.2)]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos, data.qvel = Q[0, : plant.n], V[0, : plant.n]
    mujoco.mj_forward(model, data)
    p = rows(plant, numbers)
    p["payload"][:], p["tilt"][:] = 0.3, 0.2
    integrator, off = Integrator(plant, p, H), np.zeros((1, plant.n))
    first = start(Q[:, : plant.n], V[:, : plant.n])
    slope = integrator._slope(integrator.forces, first.y, first.s, off, 0.0)
    assert np.allclose(slope[1, 0], data.qacc, rtol=1e-7)


def test_an_arm_with_a_shifted_shoulder_encoder_moves_like_a_tilted_one() -> None:
    q, v = np.array([[0.4, -0.7]]), np.array([[1.0, -2.0]])
    nominal = rows(PLANTS["arm"], draw_nominal(PLANTS["arm"], np.random.default_rng(0)), 1)
    tilted = nominal | {"tilt": nominal["tilt"] + 0.03}
    shifted = PLANTS["arm"].bias(q - [0.03, 0.0], v, prepare(PLANTS["arm"], nominal))
    assert np.allclose(shifted, PLANTS["arm"].bias(q, v, prepare(PLANTS["arm"], tilted)))
