"""MuJoCo Warp gives the same physics as MuJoCo, within what its float32 allows; here on its CPU device."""

import numpy as np
import pytest

warp = pytest.importorskip("warp", reason="needs MuJoCo Warp")
pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp")

ENVS = 4
MM = 1e-3


@pytest.fixture(scope="module", autouse=True)
def quick_to_compile():
    """The kernels are compiled once a machine (half a minute); without optimisation in half the time."""
    before, warp.config.optimization_level = warp.config.optimization_level, 0
    yield
    warp.config.optimization_level = before


@pytest.fixture
def both(make_backend):
    """both(**as make_backend): push on MuJoCo and on MuJoCo Warp, reset to the same states."""

    def make(**settings):
        pair = [make_backend("push", ENVS, physics=physics, **settings) for physics in ("mujoco", "warp")]
        for backend in pair:
            backend.seed(3)
            backend.reset(np.arange(ENVS))
        return pair

    return make


def test_the_arm_moves_alike_in_randomised_models(both) -> None:
    mujoco, warp = both(randomised=True, effects_={"actuator_delay": {"delay": 0.02}})
    rng = np.random.default_rng(0)
    for _ in range(6):
        action = rng.uniform(-1, 1, (ENVS, 2))
        action[:, 0] = -1  # away from the puck
        mujoco.send(action), warp.send(action)
    joints = mujoco.qpos[:, :7] - warp.qpos[:, :7]
    assert np.abs(np.diff(mujoco.qpos[:, :7], axis=0)).max() > 0.01  # four different models
    assert np.abs(joints).max() < 2e-5  # [rad]
    for name, mine in mujoco.samples().items():
        np.testing.assert_allclose(warp.samples()[name], mine, atol=2e-2 if name == "force" else 1e-4, rtol=1e-3)


def test_a_puck_slides_as_far(both) -> None:
    mujoco, warp = both()
    for backend in (mujoco, warp):
        backend.qpos[:, 7:9], backend.qpos[:, 10:14] = [0.4, 0.0], [1, 0, 0, 0]
        backend.qvel[:, 7:9] = np.stack([np.linspace(0.3, 1.2, ENVS), np.full(ENVS, 0.3)], 1)
    for _ in range(4):
        mujoco.send(np.zeros((ENVS, 2))), warp.send(np.zeros((ENVS, 2)))
    slid = mujoco.qpos[:, 7] - 0.4
    assert (slid > 10 * MM).all() and slid[-1] > 100 * MM
    assert np.abs(mujoco.qpos[:, 7:9] - warp.qpos[:, 7:9]).max() < 0.3 * MM


def test_contacts_amplify_the_last_digit_in_mujoco_too(make_backend) -> None:
    """Why a push of both engines is compared by how it ends: a micrometre aside becomes a millimetre within a push."""
    ends = []
    for aside in (0.0, 1e-6):
        backend = make_backend("push", ENVS)
        backend.seed(3)
        tip = backend.reset(np.arange(ENVS))[:, :2]
        backend.qpos[:, 7] = tip[:, 0] + 0.245 + aside
        backend.qpos[:, 8], backend.qpos[:, 10:14] = tip[:, 1] + np.linspace(0, 0.012, ENVS), [1, 0, 0, 0]
        for _ in range(6):
            outcome = backend.send(np.tile([1.0, 0.0], (ENVS, 1)))
        ends.append(outcome.observation[:, 2:])
    assert np.abs(ends[0] - ends[1]).max() > 1 * MM


def test_an_episode_ends_alike(both) -> None:
    """Each world's own policy acts on what it sees."""
    ends = []
    for backend in both():
        seen = backend.task.observe(backend.qpos, backend.qvel)
        for _ in range(backend.task.episode_steps):
            outcome = backend.send(backend.task.scripted(seen))
            seen = outcome.observation
        ends.append(outcome)
        assert not backend.counters
    assert ends[0].success.all() and ends[1].success.all()
    assert np.median(np.abs(ends[0].observation - ends[1].observation)[:, 2]) < 5 * MM  # along the push


def test_a_failed_simulation_is_marked_and_reset(both, caplog) -> None:
    _, warp = both(effects_={"actuator_delay": {"delay": 0.1}})
    warp.send(np.ones((ENVS, 2)))
    warp.qvel[1] = np.nan
    outcome = warp.send(np.ones((ENVS, 2)))
    assert outcome.invalid.tolist() == [False, True, False, False]
    assert warp.counters["unstable"] == 1 and "BADQVEL" in caplog.text
    others = warp.qpos[[0, 2, 3]].copy()
    first = warp.reset(np.array([1]))
    assert np.isfinite(first).all() and (warp.qpos[[0, 2, 3]] == others).all()
    held = warp.send(np.zeros((ENVS, 2)))
    assert not held.invalid.any()
    assert np.abs(held.observation[1, :2] - first[0, :2]).max() < 1 * MM  # its command history holds the new start


def test_what_it_cannot_vary_is_said(make_backend) -> None:
    draws = {"axis": {"fields": ["geom_condim"], "operation": "set", "low": 3, "high": 4}}
    with pytest.raises(ValueError, match="geom_condim.*physics=mujoco"):
        make_backend("push", 2, draws=draws, physics="warp")


def test_it_is_said_what_brings_it(make_backend, monkeypatch) -> None:
    monkeypatch.setattr("envs.backends.sim.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"mpc_sgft\[warp\]"):
        make_backend("push", 2, physics="warp")
    with pytest.raises(ValueError, match="allowed: mujoco, warp"):
        make_backend("push", 2, physics="newton")
