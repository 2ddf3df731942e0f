"""Dry friction holds exactly, stops where it should, and LuGre settles on the Stribeck curve."""

import numpy as np

from tools.studies.blind.integrate import Integrator, start
from tools.studies.blind.library import LIBRARY
from tools.studies.blind.loop import H
from tools.studies.blind.plants import PLANTS
from tools.studies.blind.truths import Forces, rows

SLIDE = PLANTS["slide"]
SCALES = {"V": 0.1, "top": 0.3, "J": 4.0}
BLOCK = {"m": 3.0, "armature": [1.0], "damping": [0.0], "dry": [2.0], "gear": [10.0], "limit": [1e9]}


def push(integrator: Integrator, state, force: float, steps: int):
    u = np.full((1, 1), force / 10.0)
    for k in range(steps):
        state = integrator.step(state, (u, u, u), k * H)
    return state


def test_a_block_at_rest_holds_exactly_below_the_dry_friction() -> None:
    integrator = Integrator(SLIDE, rows(SLIDE, BLOCK), H)
    state = push(integrator, start(np.full((1, 1), 0.1), np.zeros((1, 1))), 1.999, 1000)
    assert state.y[0, 0, 0] == 0.1 and state.y[1, 0, 0] == 0.0


def test_above_it_the_block_moves_with_what_is_left() -> None:
    integrator = Integrator(SLIDE, rows(SLIDE, BLOCK), H)
    state = push(integrator, start(np.zeros((1, 1)), np.zeros((1, 1))), 2.4, 1000)
    assert np.isclose(state.y[1, 0, 0], 0.1 * 1000 * H, rtol=1e-12)  # (2.4 - 2) N / 4 kg


def test_a_sliding_block_stops_where_its_kinetic_energy_is_used_up() -> None:
    integrator = Integrator(SLIDE, rows(SLIDE, BLOCK), H)
    state = push(integrator, start(np.zeros((1, 1)), np.full((1, 1), 0.3)), 0.0, 4000)
    assert np.isclose(state.y[0, 0, 0], 0.5 * 4.0 * 0.3**2 / 2.0, rtol=1e-9)
    assert state.y[1, 0, 0] == 0.0


def test_friction_turns_round_within_a_step_when_the_block_does() -> None:
    """Up a slope and down again: 5 N back, 2 N friction: it stops after v m / 7 s and then gains 3 N / 4 kg."""
    integrator = Integrator(SLIDE, rows(SLIDE, BLOCK), H)
    v, steps = 0.33333, 2500
    state = push(integrator, start(np.zeros((1, 1)), np.full((1, 1), v)), -5.0, steps)
    back = steps * H - v * 4 / 7
    assert np.isclose(state.y[1, 0, 0], -0.75 * back, rtol=1e-10)
    assert np.isclose(state.y[0, 0, 0], v * v * 4 / 14 - 0.375 * back**2, rtol=1e-9)


def test_an_elbow_holds_while_the_shoulder_swings() -> None:
    plant = PLANTS["arm"]
    from tools.studies.blind.mjcf import draw_nominal

    numbers = draw_nominal(plant, np.random.default_rng(0)) | {"dry": [0.0, 50.0]}
    integrator = Integrator(plant, rows(plant, numbers), H)
    state, off = start(np.array([[0.7, 0.4]]), np.array([[0.5, 0.0]])), np.zeros((1, 2))
    for k in range(1500):
        state = integrator.step(state, (off, off, off), k * H)
    assert state.y[0, 0, 1] == 0.4 and abs(state.y[0, 0, 0] - 0.7) > 0.05


def test_direction_decides_the_viscous_friction() -> None:
    p = rows(SLIDE, BLOCK | {"dry": [0.0]}, 2)
    p["b_pos"][:], p["b_neg"][:] = 1.0, 4.0
    integrator, off = Integrator(SLIDE, p, H), np.zeros((2, 1))
    state = start(np.zeros((2, 1)), np.array([[0.2], [-0.2]]))
    for k in range(1000):
        state = integrator.step(state, (off, off, off), k * H)
    assert np.allclose(state.y[1, :, 0], [0.2 * np.exp(-0.2 / 4), -0.2 * np.exp(-0.2)], rtol=1e-10)


def test_lugre_settles_on_the_stribeck_curve() -> None:
    speeds = np.array([[0.01], [0.03], [0.06], [0.2], [-0.05]])
    p = rows(SLIDE, BLOCK | {"dry": [0.0]}, len(speeds))
    for name, value in {"bristle": 2e4, "kinetic": 1.0, "static": 1.6, "stribeck_speed": 0.05}.items():
        p[name][:] = value
    p["bristle_damping"][:] = 30.0
    forces, z = Forces(SLIDE, p), np.zeros_like(speeds)
    for _ in range(20000):
        z = z + 1e-5 * forces.bending(speeds, z)
    curve = np.sign(speeds) * (1.0 + 0.6 * np.exp(-((speeds / 0.05) ** 2)))
    assert np.allclose(forces.resistance(np.zeros_like(z), speeds, z), curve, rtol=1e-3)


def test_what_stribeck_friction_does_vanishes_with_its_size_beside_known_dry_friction() -> None:
    p, sizes = rows(SLIDE, BLOCK, 4), (0.0, 1e-4, 1e-2, 1e-1)
    for row, size in enumerate(sizes[1:], 1):
        LIBRARY["stribeck_friction"].apply(p, np.array([row]), 0, size, {"ratio": 0.5, "speed": 0.5}, SCALES)
    integrator, state = Integrator(SLIDE, p, H), start(np.zeros((4, 1)), np.full((4, 1), 0.2))
    for k in range(4000):  # to rest and back
        u = np.full((4, 1), -0.3 * np.sin(3 * k * H))
        state = integrator.step(state, (u, u, u), k * H)
    moved = np.abs(state.y[0, 1:, 0] - state.y[0, 0, 0])
    assert np.all(np.diff(moved) > 0) and moved[0] < 0.02 * moved[2]
