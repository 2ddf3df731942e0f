"""Walker and cheetah: their sizes, their rewards, how they stand, and that they can go forward in both worlds."""

import mujoco
import numpy as np
import pytest
import yaml

from tests.envs.conftest import CONFIGS

TASKS = ["walker_walk", "cheetah_run"]
REAL = {"walker_walk": "walker_real", "cheetah_run": "cheetah_real"}
MIRRORED = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # joints of the walker, its legs changed


def _gap(name: str) -> dict:
    return yaml.safe_load((CONFIGS / f"gap/{name}.yaml").read_text())["effects"]


def _episode(backend, policy) -> tuple[np.ndarray, np.ndarray]:
    """How far each machine came [N] m, and the reward of each step [T, N]."""
    backend.seed(0)
    seen, rewards = backend.reset(np.arange(backend.num_envs)), []
    for _ in range(backend.task.episode_steps):
        outcome = backend.send(policy(seen))
        seen = outcome.observation
        rewards.append(outcome.reward)
    return backend.qpos[:, 0].copy(), np.array(rewards)


def test_they_weigh_what_those_of_dm_control_do(build, make_task) -> None:
    walker, cheetah = (build(make_task(task).spec()) for task in TASKS)
    assert [walker.body(name).mass[0] for name in ("torso", "left_thigh", "right_shin", "left_foot")] == pytest.approx(
        [10.673, 4.058, 2.781, 2.094], abs=5e-4
    )
    assert cheetah.body_mass.sum() == pytest.approx(14.0)
    assert cheetah.body("torso").mass[0] == pytest.approx(6.250, abs=5e-4)


@pytest.mark.parametrize("task", TASKS)
def test_the_speed_is_that_of_the_centre_of_mass_and_the_lowest_point_the_lowest(build, make_task, task) -> None:
    task, rng = make_task(task), np.random.default_rng(0)
    model = build(task.spec())
    data = mujoco.MjData(model)
    bones = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    for _ in range(5):
        data.qpos, data.qvel = rng.uniform(-2, 2, model.nq), rng.uniform(-5, 5, model.nv)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        speed = task.forward(data.qpos[None, 2:] @ task.chain.T, data.qvel[None])
        np.testing.assert_allclose(speed, data.body("torso").subtree_linvel[0], atol=1e-9)
        upward = np.abs(data.geom_xmat[bones, 8])
        low = data.geom_xpos[bones, 2] - model.geom_size[bones, 1] * upward - model.geom_size[bones, 0]
        np.testing.assert_allclose(task.lowest(data.qpos[None]), low.min(), atol=1e-9)


def test_walker_rewards_by_hand(make_task) -> None:
    task = make_task("walker_walk")
    qpos, qvel = np.zeros((2, 5, 9))
    qvel[:, 0] = [1.0, 0.5, -1.0, 3.0, 1.0]
    qpos[3, 1] = 0.6 - 1.3  # the torso lies 60 cm below where it stands
    qpos[4, 2], qpos[4, [3, 6]] = np.pi / 2, -np.pi / 2  # bent forward on upright legs
    seen = task.observe(qpos, qvel)
    expected = [1.0, 3.5 / 6, 1 / 6, (0.3 + 1) / 4, (3 + 0.5) / 4]
    np.testing.assert_allclose(task.reward(seen, np.zeros((5, 6))), expected, atol=1e-12)
    assert task.success(seen).tolist() == [True, False, False, False, True]


def test_cheetah_rewards_by_hand(make_task) -> None:
    task = make_task("cheetah_run")
    qpos, qvel = np.zeros((2, 4, 9))
    qvel[:, 0] = [0.0, 5.0, 20.0, -5.0]
    seen = task.observe(qpos, qvel)
    np.testing.assert_allclose(task.reward(seen, np.zeros((4, 6))), [0.0, 0.5, 1.0, 0.0], atol=1e-12)
    assert task.success(seen).tolist() == [False, True, True, False]


@pytest.mark.parametrize("task", TASKS)
def test_where_it_is_along_x_changes_nothing(make_backend, random_actions, task) -> None:
    seen = []
    for x in (0.0, 30.0):
        backend = make_backend(task, 4)
        first = backend.reset(np.arange(4))
        backend.qpos[:, 0] += x
        assert np.array_equal(backend.task.observe(backend.qpos, backend.qvel), first)
        for action in random_actions(10, 4, 6):
            outcome = backend.send(action)
        seen.append(outcome.observation)
    np.testing.assert_allclose(*seen, atol=1e-6)


def test_the_legs_of_the_walker_are_alike(make_backend, random_actions) -> None:
    backend = make_backend("walker_walk", 2, changes={"anywhere_share": 1.0})
    backend.reset(np.arange(2))
    backend.qpos[1] = backend.qpos[0, MIRRORED]
    for action in random_actions(20, 6):
        backend.send(np.array([action, action[[3, 4, 5, 0, 1, 2]]]))
    np.testing.assert_allclose(backend.qpos[1], backend.qpos[0, MIRRORED], atol=1e-6)
    assert np.abs(backend.qpos[0, 3:6] - backend.qpos[0, 6:]).max() > 0.1


@pytest.mark.parametrize("task", TASKS)
def test_episodes_start_on_the_floor_standing_or_anywhere(make_backend, task) -> None:
    for share, lean in ((0.0, 0.1), (1.0, np.pi)):
        backend = make_backend(task, 64, changes={"anywhere_share": share})
        backend.reset(np.arange(64))
        qpos, links = backend.qpos, backend.task.links
        np.testing.assert_allclose(backend.task.lowest(qpos), 0.0, atol=1e-9)
        assert 0.7 * lean < np.abs(qpos[:, 2]).max() <= lean
        for joint, link in zip(qpos[:, 3:].T, links[1:], strict=True):
            assert (joint >= link.range[0]).all() and (joint <= link.range[1]).all()
            assert np.ptp(joint) > 0.7 * (share and np.ptp(link.range))


@pytest.mark.parametrize("task", TASKS)
def test_the_floor_decides_how_they_slide(build, make_task, task) -> None:
    model = build(make_task(task, friction=0.3).spec())
    data = mujoco.MjData(model)
    data.qpos[1] = -0.3
    mujoco.mj_forward(model, data)
    floor = [c for c in data.contact if model.geom("floor").id in c.geom]
    assert floor and all(c.friction[0] == 0.3 for c in floor)


@pytest.mark.parametrize("task", TASKS)
def test_the_real_one_has_twice_the_mass_in_the_same_places(build, make_task, task) -> None:
    spec = make_task(task).spec()
    nominal, real = build(spec), build(spec, _gap(REAL[task]))
    for name in (nominal.body(i).name for i in range(1, nominal.nbody)):
        link, load = real.body(name), real.body(f"payload_{name}")
        assert load.mass[0] == pytest.approx(nominal.body(name).mass[0], rel=1e-3)
        np.testing.assert_allclose(load.pos, link.ipos, atol=1e-4)
        np.testing.assert_allclose(link.inertia, nominal.body(name).inertia)


@pytest.mark.parametrize("task", TASKS)
def test_doing_nothing_gets_nowhere(make_backend, task) -> None:
    far, rewards = _episode(make_backend(task, 8), lambda seen: np.zeros((8, 6)))
    assert np.abs(far).max() < 1.5 and rewards[-20:].mean() < 0.2


@pytest.mark.parametrize(("task", "metres"), [("walker_walk", 4.5), ("cheetah_run", 14.0)])
def test_the_scripted_policy_goes_forward_and_less_so_where_all_is_twice_as_heavy(make_backend, task, metres) -> None:
    (far, rewards), (_, real) = (
        _episode(backend, backend.task.scripted)
        for backend in (make_backend(task, 32), make_backend(task, 32, effects_=_gap(REAL[task])))
    )
    assert np.median(far) > metres
    assert real.sum(0).mean() < 0.7 * rewards.sum(0).mean()


def test_the_scripted_walker_stays_upright(make_backend) -> None:
    backend, lowest = make_backend("walker_walk", 32), np.full(32, np.inf)

    def watch(seen: np.ndarray) -> np.ndarray:
        lowest[:] = np.minimum(lowest, seen[:, backend.task.observation_names.index("height")])
        return backend.task.scripted(seen)

    _episode(backend, watch)
    assert (lowest > 0.85).mean() > 0.7


def test_the_scripted_walker_knows_no_left_and_right(make_task) -> None:
    task, rng = make_task("walker_walk"), np.random.default_rng(0)
    qpos, qvel = rng.uniform(-1, 1, (2, 8, 9))
    action, mirrored = (
        task.scripted(task.observe(q, v)) for q, v in ((qpos, qvel), (qpos[:, MIRRORED], qvel[:, MIRRORED]))
    )
    np.testing.assert_allclose(mirrored, action[:, [3, 4, 5, 0, 1, 2]], atol=1e-12)
    assert (np.abs(action) <= 1).all()
