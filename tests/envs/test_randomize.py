"""The randomiser writes what its table says, anew for each episode, and nothing else."""

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs import randomize
from envs.env import ControlEnv
from envs.tasks import push

N = 32
LATENCY = {"latency": {"fields": ["actuator_delay"], "operation": "set", "low": 0.0, "high": 0.2}}


def _drawn(backend) -> dict[str, np.ndarray]:
    return {name: np.array(array) for name, array in backend.randomizer.arrays.items()}


def test_push_draws_what_its_table_says(make_backend) -> None:
    backend = make_backend("push", 64, randomised=True)
    backend.reset(np.arange(64))
    model, drawn = backend.model, _drawn(backend)
    puck, geom = model.body("puck").id, model.geom("puck").id

    mass = drawn["body_mass"][:, puck] / model.body_mass[puck]
    friction = drawn["geom_friction"][:, geom, 0] / model.geom_friction[geom, 0]
    gain = drawn["actuator_gainprm"][:, :, 0] / model.actuator_gainprm[:, 0]
    for values, low, high in ((mass, 0.5, 2.0), (friction, 0.75, 1.5), (gain[:, 0], 0.5, 1.25)):
        assert low <= values.min() and values.max() <= high and np.ptp(values) > 0.8 * (high - low)
    np.testing.assert_allclose(drawn["body_inertia"][:, puck] / model.body_inertia[puck], mass[:, None].repeat(3, 1))
    np.testing.assert_allclose(gain, gain[:, :1].repeat(7, 1))  # one draw for all joints
    np.testing.assert_allclose(drawn["actuator_biasprm"][:, :, 1], -drawn["actuator_gainprm"][:, :, 0])
    np.testing.assert_allclose(drawn["actuator_biasprm"][:, :, 2], np.tile(model.actuator_biasprm[:, 2], (64, 1)))
    delay = drawn["actuator_delay"]
    assert 0 <= delay.min() and delay.max() <= 0.15 and np.ptp(delay[:, 0]) > 0.12
    np.testing.assert_allclose(delay, delay[:, :1].repeat(7, 1))
    others = np.delete(np.arange(model.nbody), puck)
    np.testing.assert_array_equal(drawn["body_mass"][:, others], np.tile(model.body_mass[others], (64, 1)))


def test_a_place_in_a_range_is_a_number_of_its_unit() -> None:
    flat = randomize.Draw(("dof_damping",), low=-1.0, high=3.0)
    steep = randomize.Draw(("dof_damping",), low=0.5, high=8.0, distribution="loguniform")
    assert [flat.value(x) for x in (0, 0.25, 1)] == [-1, 0, 3]
    np.testing.assert_allclose([steep.value(x) for x in (0, 0.5, 1)], [0.5, 2, 8])


def test_a_model_of_ones_own_is_changed_as_those_of_the_batch(make_backend) -> None:
    backend = make_backend("push", 3, randomised=True)
    backend.reset(np.arange(3))
    draws = backend.randomizer.draws
    for sim, places in enumerate(backend.randomizer.places):
        model = randomize.changed(backend.model, draws, [d.value(x) for d, x in zip(draws, places, strict=True)])
        for name, array in _drawn(backend).items():
            np.testing.assert_array_equal(getattr(model, name), array[sim], name)
        assert model.body_subtreemass[0] != backend.model.body_subtreemass[0], "what follows from the mass, too"


def test_beta_distributions_take_the_place_of_uniform_ones(make_backend) -> None:
    backend = make_backend("push", 400, randomised=True)
    backend.randomizer.shapes = np.array([[1.0, 1.0], [90.0, 10.0], [1.0, 1.0], [2.0, 2.0]])  # in the table's order
    backend.reset(np.arange(400))
    places = backend.randomizer.places
    np.testing.assert_allclose(places.mean(0), [0.5, 0.9, 0.5, 0.5], atol=0.06)
    np.testing.assert_allclose(places.std(0), [12**-0.5, 0.03, 12**-0.5, 20**-0.5], rtol=0.15)
    geom = backend.model.geom("puck").id
    friction = _drawn(backend)["geom_friction"][:, geom, 0] / backend.model.geom_friction[geom, 0]
    np.testing.assert_allclose(friction, 0.75 + 0.75 * places[:, 1])
    assert len(np.unique(places)) == places.size


def test_what_follows_from_the_mass_is_computed_anew(make_backend) -> None:
    backend = make_backend("push", N, randomised=True)
    backend.reset(np.arange(N))
    mass, weight = backend.randomizer.arrays["body_mass"], backend.batch.expanded("body_invweight0")
    puck = backend.model.body("puck").id
    np.testing.assert_allclose(weight[:, puck, 0], 1 / mass[:, puck], rtol=1e-6)
    assert np.ptp(weight[:, puck, 0]) > 1


def test_a_heavier_puck_is_heavier_in_the_simulation(make_backend) -> None:
    table = {"mass": {"fields": ["body_mass", "body_inertia"], "at": ["puck"], "low": 0.5, "high": 2.0}}
    backend = make_backend("push", N, draws=table)
    backend.reset(np.arange(N))
    mass = backend.randomizer.arrays["body_mass"][:, backend.model.body("puck").id]
    backend.qpos[:, 9] += 0.1  # lifted off the table
    backend.applied[:, 7] = 0.3  # N along x
    backend.batch.step(nstep=10)
    np.testing.assert_allclose(backend.qvel[:, 7], 0.3 / mass * 0.04, rtol=1e-6)


def test_each_episode_starts_from_the_nominal_model(make_backend) -> None:
    table = {
        "scaled": {"fields": ["dof_damping"], "at": ["hinge"], "operation": "scale", "low": 2.0, "high": 2.0},
        "added": {"fields": ["body_mass"], "at": ["rod"], "operation": "add", "low": 0.5, "high": 0.5},
    }
    backend = make_backend("pendulum", 2, draws=table)
    for _ in range(3):
        backend.reset(np.arange(2))
        np.testing.assert_allclose(backend.randomizer.arrays["dof_damping"], 0.1)
        np.testing.assert_allclose(backend.randomizer.arrays["body_mass"][:, 1], 1.5)


def test_draws_are_a_function_of_the_seed_and_new_each_episode(make_backend) -> None:
    backend = make_backend("push", 4, randomised=True)
    everyone, episodes = np.arange(4), {}
    for seed in (5, 5, 6):
        backend.seed(seed)
        backend.reset(everyone)
        first = _drawn(backend)
        backend.reset(everyone)
        episodes.setdefault(seed, []).append((first, _drawn(backend)))
    (a, b), (c, d) = episodes[5]
    other = episodes[6][0][0]
    for name in ("geom_friction", "body_mass", "actuator_delay"):
        np.testing.assert_array_equal(a[name], c[name])
        np.testing.assert_array_equal(b[name], d[name])
        assert not np.array_equal(a[name], b[name]) and not np.array_equal(a[name], other[name])


def test_a_partial_reset_draws_only_for_those_that_start(make_backend) -> None:
    backend = make_backend("push", 4, randomised=True)
    backend.reset(np.arange(4))
    before = _drawn(backend)
    backend.reset(np.array([1, 3]))
    after = _drawn(backend)
    np.testing.assert_array_equal(before["body_mass"][[0, 2]], after["body_mass"][[0, 2]])
    assert (before["actuator_delay"][[1, 3]] != after["actuator_delay"][[1, 3]]).all()


def test_each_simulation_answers_after_its_own_latency(make_backend) -> None:
    backend = make_backend("pendulum", N, draws=LATENCY)
    backend.reset(np.arange(N))
    backend.qpos[:], backend.qvel[:] = np.pi, 0.0
    moved = []
    for _ in range(4):
        backend.send(np.ones((N, 1)))
        moved.append(np.abs(backend._last["qpos"][:, :, 0] - np.pi) > 1e-9)
    first = np.concatenate(moved, 1).argmax(1)  # index of the first physics step that shows the torque
    delay = backend.randomizer.arrays["actuator_delay"][:, 0]
    np.testing.assert_array_equal(first, np.ceil(delay / 0.01 - 1e-9))
    assert np.ptp(first) > 10


@pytest.mark.parametrize("task", ["push", "pendulum"])
def test_the_longest_delay_of_the_buffer_is_not_clipped(make_backend, task) -> None:
    held = {"push": push.NSAMPLE * 0.004, "pendulum": 2.0}[task]
    table = {"latency": {**LATENCY["latency"], "low": held, "high": held}}
    backend = make_backend(task, 1, draws=table)
    backend.reset(np.arange(1))
    if task == "pendulum":
        backend.qpos[:], backend.qvel[:] = np.pi, 0.0
    arm = slice(0, 7 if task == "push" else 1)
    start, periods = backend.qpos[:, arm].copy(), round(held / backend.task.control_dt)
    for _ in range(periods):
        backend.send(np.ones((1, backend.task.action_dim)))
        assert np.abs(backend.qpos[:, arm] - start).max() < 0.005
    backend.send(np.ones((1, backend.task.action_dim)))
    assert np.abs(backend.qpos[:, arm] - start).max() > 0.01


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        ({"high": 1.2}, "randomised actuator_delay of 1.2 to 1.2 s: the model's history holds 0 to 1 s"),
        ({"low": -0.1}, "randomised actuator_delay of -0.1 to -0.1 s"),
        ({"operation": "add", "high": 1.01}, "actuator_delay of 1.01 to 1.01 s"),
    ],
)
def test_a_delay_that_the_buffer_cannot_hold_is_refused(make_backend, draw, message) -> None:
    with pytest.raises(ValueError) as error:
        make_backend("push", 1, draws={"latency": {**LATENCY["latency"], **draw}})
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        ({"operation": "divide"}, "operation='divide'; allowed: add, scale, set"),
        ({"distribution": "normal"}, "distribution='normal'; allowed: uniform, loguniform"),
        ({"low": 2.0, "high": 1.0}, "range 2.0 to 1.0 is empty"),
        ({"low": 0.0, "distribution": "loguniform"}, "not positive"),
        ({"centre": 1.0}, "randomize draw 'mass': .*centre.*It has: fields, low, high"),
        ({"fields": ["body_colour"]}, "no field 'body_colour'"),
        ({"fields": ["geom_friction[9]"], "at": []}, "geom_friction has the shape"),
        ({"fields": ["body_mass[0]"]}, "body_mass has the shape"),
        ({"fields": ["qpos0"]}, "only fields of body, geom, dof, jnt, actuator, tendon"),
        ({"at": ["pucks"]}, "randomise body_mass: .*pucks.*puck"),
    ],
)
def test_a_table_that_makes_no_sense_is_refused(make_backend, draw, message) -> None:
    with pytest.raises(ValueError, match=message):
        make_backend("push", 1, draws={"mass": {"fields": ["body_mass"], "at": ["puck"], "low": 1, "high": 2, **draw}})


def test_a_missing_key_is_named() -> None:
    with pytest.raises(ValueError, match="randomize draw 'mass': .*'high'"):
        randomize.load({"mass": {"fields": ["body_mass"], "low": 1.0}})


@pytest.mark.parametrize(
    "gap",
    [
        {"gravity_tilt": {"roll": 0.05}},
        {"stribeck_friction": {"coulomb": 0.1, "static": 0.2}},
        {"backlash": {"gap": 0.02, "at": ["joint1"]}},
        {"joint_stiffness": {"stiffness": 1.0, "at": ["joint1"]}},
    ],
    ids=lambda gap: next(iter(gap)),
)
@pytest.mark.parametrize("task", ["push", "rope_peg_in_hole"])
def test_what_effects_add_to_a_scene_is_not_drawn(make_backend, gap, task) -> None:
    """Actuators without an input have no history that a latency fits in, and a play is no rope."""
    table = dict(LATENCY)
    if task == "rope_peg_in_hole":
        table |= {"rope": {"fields": ["tendon_range[1]"], "operation": "scale", "low": 0.5, "high": 0.5}}
    plain, backend = (make_backend(task, 1, effects_=effects_, draws=table) for effects_ in ({}, gap))
    for each in (plain, backend):
        each.reset(np.arange(1))
    for name, drawn in _drawn(plain).items():
        there, own = _drawn(backend)[name][0], len(drawn[0])
        np.testing.assert_allclose(there[:own], drawn[0])
        np.testing.assert_allclose(there[own:], np.array(getattr(backend.model, name))[own:])


def test_a_gain_that_is_drawn_leaves_an_offset_where_it_is(make_backend) -> None:
    """What is added to a servo's target, in radians, is the same for every gain."""
    gap = {"actuator_offset": {"offset": 0.05, "at": ["position2"]}}
    backend = make_backend("push", 8, effects_=gap, randomised=True)
    backend.reset(np.arange(8))
    drawn, second = _drawn(backend), backend.model.actuator("position2").id
    offset = drawn["actuator_biasprm"][:, second, 0] / drawn["actuator_gainprm"][:, second, 0]
    np.testing.assert_allclose(offset, 0.05)
    assert np.ptp(drawn["actuator_gainprm"][:, second, 0]) > 0


def test_damping_that_is_drawn_leaves_what_was_found_out(make_backend) -> None:
    drawn = []
    for gap in ({}, {"viscous_friction": {"coefficient": 800.0, "at": ["nail"]}}):
        backend = make_backend("hammer", 4, effects_=gap, randomised=True)
        backend.reset(np.arange(4))
        drawn.append(_drawn(backend)["dof_damping"][:, backend.model.joint("nail").dofadr[0]])
    assert 250 <= drawn[0].min() and drawn[0].max() <= 2500
    np.testing.assert_allclose(drawn[1], 2 * drawn[0])


def test_a_bare_name_is_a_list_of_one() -> None:
    (draw,) = randomize.load({"mass": {"fields": "body_mass", "at": "puck", "low": 1.0, "high": 2.0}})
    assert (draw.fields, draw.at) == (("body_mass",), ("puck",))


def test_a_free_joint_has_six_degrees_of_freedom(make_backend) -> None:
    table = {"drag": {"fields": ["dof_damping"], "at": ["puck"], "operation": "set", "low": 0.7, "high": 0.7}}
    backend = make_backend("push", 2, draws=table)
    backend.reset(np.arange(2))
    damping = backend.randomizer.arrays["dof_damping"]
    assert (damping[:, 7:13] == 0.7).all() and (damping[:, :7] == backend.model.dof_damping[:7]).all()
    assert backend.model.joint("puck").type == mujoco.mjtJoint.mjJNT_FREE


def test_observation_noise_falls_on_its_share_of_the_episodes(make_backend) -> None:
    noisy, plain = (make_backend("push", 200, noise_sd=sd, noise_probability=0.3) for sd in (0.004, 0.0))
    for backend in (noisy, plain):
        backend.seed(2)
    error = noisy.reset(np.arange(200)) - plain.reset(np.arange(200))
    hit = error.any(1)
    assert 0.2 < hit.mean() < 0.4
    assert error[hit].std() == pytest.approx(0.004, rel=0.2)


def test_draws_that_are_no_mapping_are_refused():
    with pytest.raises(ValueError, match="must map names to draws"):
        randomize.load([])  # type: ignore[arg-type]


def test_what_only_the_simulator_knows_is_told_where_it_is_asked_for(make_backend) -> None:
    backend = make_backend("push", 3, randomised=True)
    backend.noise_sd, backend.noise_probability = 0.01, 1.0
    plain = ControlEnv(backend, history=1)
    assert "privileged" not in plain.reset().keys()
    env = ControlEnv(backend, history=1, privileged=backend.privileged)
    check_env_specs(env)
    state = env.rollout(3)
    told = torch.cat([state["privileged"], state["next", "privileged"][:, -1:]], 1)
    seen = torch.cat([state["observation"], state["next", "observation"][:, -1:]], 1)[..., :4]
    noise = seen - told[..., :4]
    assert 0.005 < noise.std() < 0.015 and (noise != 0).all()
    assert (told[..., 4:] == told[:, :1, 4:]).all(), "an episode has one model"
    assert told[:, 0, 4:].unique().numel() == 12 and told[..., 4:].min() >= 0 and told[..., 4:].max() <= 1
    backend.reset(np.arange(3))
    backend.qpos[1] = np.nan
    backend._check_physics()
    known = backend.privileged()
    assert (known[1] == 0).all() and np.isfinite(known).all() and (known[0] != 0).all()
    np.testing.assert_array_equal(known[2, 4:], backend.randomizer.places[2])
    np.testing.assert_array_equal(known[2, :4], backend.task.observe(backend.qpos, backend.qvel)[2])
