"""The simulator's side: held commands, its own error, and effects."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.candidates.effect_table import TABLE, TypicalSizes
from mpc_sgft.diagnose.candidates.library import candidates, enrich, make_term
from mpc_sgft.diagnose.data.held_commands import held_mean
from mpc_sgft.diagnose.data.measured import Episode
from mpc_sgft.diagnose.data.smooth import smooth
from mpc_sgft.diagnose.data.windows import AFTER, BEFORE
from mpc_sgft.diagnose.fitting.prepare import discrepancy, prepare, typical_sizes
from mpc_sgft.diagnose.simulation.load_friction import Drives
from mpc_sgft.diagnose.simulation.plant import Change, Plant
from mpc_sgft.diagnose.simulation.replay import Replayer, _same_layout

SLIDE = """<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="2"/></body></worldbody><actuator><motor name="motor" joint="x"/></actuator></mujoco>"""


@pytest.fixture
def plant() -> Plant:
    return Plant(mujoco.MjSpec.from_string(SLIDE))


def _sine() -> Episode:
    """m q'' = u with u = 2 sin(3 t): q = -sin(3 t) / 9 + t / 3 from rest; u is held for 1 ms."""
    t = np.arange(2000) * 0.001
    held = 2 * np.sin(3 * (t + 0.0005))
    return Episode("sine", 0.001, held[:, None], {"qpos/x": -np.sin(3 * t) / 9 + t / 3})


def test_a_right_model_predicts_to_the_second_order(plant) -> None:
    replayer = Replayer(plant, [_sine()], 0.5, ["qpos/x"])
    error = replayer.simulate([Change()])[0] - replayer.windows.measured
    assert np.abs(error).max() < 3e-6  # the first order alone would be h a t / 2 = 5e-4 m


def test_a_model_that_the_data_contradict_is_simulated_to_the_second_order_too(plant) -> None:
    """Its acceleration at a start is not the measured one, and its damping is not that of the scene."""
    change, off = make_term(plant, "viscous_friction", "x", TypicalSizes()).build(np.array([3.0])), []
    true = Replayer(plant.sharper(2e-5), [_sine()], 0.5, ["qpos/x"])
    for h in (2e-3, 1e-3):
        coarse = true.with_plant(plant.sharper(h))
        off.append(float(np.abs(coarse.simulate([change]) - true.simulate([change])).max()))
    assert off[0] < 1e-6 and off[0] / off[1] > 2.5, off  # the first order makes 1.6e-4 m, and halves


def test_damping_that_is_stiff_stays_stable(plant) -> None:
    """A time constant of half a millisecond at steps of two: the slide creeps with u / d."""
    episode, stiff = _sine(), make_term(plant, "viscous_friction", "x", TypicalSizes()).build(np.array([4000.0]))
    still = replace(episode, signals={"qpos/x": 0 * episode.signals["qpos/x"]})
    replayer = Replayer(plant, [still], 0.5, ["qpos/x"])
    t = replayer.windows.start[:, None] * 0.001 + 0.001 * np.arange(501)
    crept = 2 / 4000 / 3 * (np.cos(3 * t[:, :1]) - np.cos(3 * t[:, 1:]))
    np.testing.assert_allclose(replayer.simulate([stiff])[0, ..., 0], crept, atol=5e-6)


def test_what_shorter_steps_would_change_is_known() -> None:
    """Beside dry friction that a motion reverses against, an error of the first order."""
    spec = mujoco.MjSpec.from_string(SLIDE.replace('axis="1 0 0"/>', 'axis="1 0 0" frictionloss="1"/>'))
    plant, fine = Plant(spec).sharper(), Plant(spec).sharper().spec.copy()
    fine.option.timestep = 1e-5
    episode = replace(_sine(), ctrl=3 * np.cos(9 * 0.001 * np.arange(2000))[:, None])
    coarse, true = (Replayer(p, [episode], 0.5, ["qpos/x"]) for p in (plant, Plant(fine)))
    off = coarse.simulate([Change()])[0] - true.simulate([Change()])[0]
    known, floor, _ = discrepancy(coarse, [], [])
    assert np.abs(off + known).max() < 0.3 * np.abs(off).max()
    assert (np.abs(off + known) <= floor[0] + 1e-12).mean() > 0.95


def test_held_mean_by_hand() -> None:
    u = np.array([1.0, 3.0])  # held on [0, 1) and [1, 2)
    edges = np.array([[0.0, 1.0], [0.5, 1.5], [1.5, 3.0], [-1.0, 0.5]])
    np.testing.assert_allclose(held_mean(u, 1.0, edges), [1.0, 2.0, 3.0, 1.0])


def test_a_delay_reaches_back_before_the_window(plant) -> None:
    episode = _sine()
    replayer = Replayer(plant, [episode], 0.5, ["qpos/x"])
    late = make_term(plant, "actuator_delay", "motor", TypicalSizes()).build(np.array([0.05]))
    moved = np.vstack([np.repeat(episode.ctrl[:1], 50, 0), episode.ctrl[:-50]])
    shifted = Replayer(plant, [Episode("late", 0.001, moved, episode.signals)], 0.5, ["qpos/x"])
    np.testing.assert_allclose(replayer.simulate([late]), shifted.simulate([Change()]), atol=1e-12)


def test_a_late_sensor_shows_what_was_true_before(plant) -> None:
    episode = _sine()
    old = np.r_[np.zeros(50), episode.signals["qpos/x"][:-50]]  # read 50 ms late
    replayer = Replayer(plant, [Episode("late", 0.001, episode.ctrl, {"qpos/x": old})], 0.5, ["qpos/x"])
    late = make_term(plant, "sensor_delay", "qpos/x", TypicalSizes()).build(np.array([0.05]))
    error = (replayer.simulate([late, Change()]) - replayer.windows.measured)[:, 1:]  # the first window begins before
    assert np.abs(error[0]).max() < 1e-4 < 3e-3 < np.abs(error[1]).max()


def test_a_force_is_what_the_joint_feels() -> None:
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.replace('joint="x"/>', 'joint="x" gear="7"/>'))).sharper()
    episode = _sine()
    replayer = Replayer(
        plant,
        [Episode("force", 0.001, episode.ctrl, {**episode.signals, "force/motor": episode.ctrl[:, 0]})],
        0.5,
        ["force/motor"],
    )
    np.testing.assert_allclose(replayer.simulate([Change()])[0], 7 * replayer.windows.measured, atol=1e-12)


@pytest.mark.parametrize(("delay", "off", "back"), [(0, 0.0, 0), (0.0007, 0.0, 1), (0.0007, 8e-4, 0), (0, -1e-4, 1)])
def test_a_force_shows_the_command_that_acts_when_it_is_read(delay: float, off: float, back: int) -> None:
    rng, plant = np.random.default_rng(0), Plant(mujoco.MjSpec.from_string(SLIDE)).sharper()
    u = rng.normal(size=1000)
    signals = {"qpos/x": np.zeros(1000), "force/motor": np.roll(u, back)}
    replayer = Replayer(plant, [Episode("force", 0.002, u[:, None], signals, off_tick=off)], 0.5, ["force/motor"])
    np.testing.assert_allclose(replayer.simulate([Change(delay=delay)])[0], replayer.windows.measured, atol=1e-6)


def test_a_drive_knows_its_limits() -> None:
    general = '<general name="motor" joint="x" gear="2" gainprm="3" forcerange="-6 6" ctrlrange="-5 5"/>'
    scene = SLIDE.replace('<motor name="motor" joint="x"/>', general)
    plant = Plant(mujoco.MjSpec.from_string(scene))
    drive = Drives.of(plant, plant.model)
    felt, then, now = np.array([[3.0, 1.0, 1.2], [6.0, 2.5, 2.4], [3.0, 1.0, 9.0], [1.5, 6.0, 7.0]]).T
    load = drive.load(*(x[:, None] for x in (felt, then, now)))
    np.testing.assert_allclose(load, np.array([[2 * 3.6, 2 * 6.0, 2 * 6.0, 2 * 1.5]]).T)
    np.testing.assert_array_equal(drive.to_joint, [[1.0]])


@pytest.fixture
def servo() -> tuple[Plant, Episode, np.ndarray]:
    """A stiff servo's plant and recording, and the force that each sample would show a moment earlier, [T]."""
    kp, kv, mass, dt, fine = 4000.0, 200.0, 2.0, 0.004, 2e-5
    drive = f'<position name="servo" joint="x" kp="{kp}" kv="{kv}"/>'
    plant = Plant(mujoco.MjSpec.from_string(SLIDE.replace('<motor name="motor" joint="x"/>', drive)))
    t, q, v, old, rows = dt * np.arange(400), 0.0, 0.0, 0.0, []
    command = 0.1 * np.sin(6.0 * t)
    for u in command:
        rows.append((q, kp * (u - q) - kv * v, kp * (old - q) - kv * v))
        for _ in range(round(dt / fine)):
            v += fine * (kp * (u - q) - kv * v) / mass
            q += fine * v
        old = u
    q_measured, force, early = np.array(rows).T
    return plant.sharper(), Episode("e", dt, command[:, None], {"qpos/x": q_measured, "force/servo": force}), early


def test_the_force_of_a_stiff_servo_is_that_of_the_sample_under_its_new_command(servo) -> None:
    plant, episode, early = servo
    replayer = Replayer(plant, [episode], 0.4, ["force/servo"])
    w, size = replayer.windows, np.abs(episode.signals["force/servo"]).max()
    error = replayer.simulate([Change()])[0] - w.measured
    assert np.median(np.abs(error)) < 0.02 * size  # what is left comes from the starts; a step late: 0.04
    before = np.array([early[s + 1 : s + 1 + w.samples] for s in w.start])[..., None]
    error = replayer.with_forces_read(BEFORE).simulate([Change()])[0] - before
    assert np.median(np.abs(error)) < 0.02 * size < np.median(np.abs(before - w.measured))


def test_forces_are_compared_on_the_side_of_their_command_where_they_were_read(servo) -> None:
    plant, episode, early = servo
    first = np.random.default_rng(0).random(len(early)) < 0.3
    force = np.where(first, early, episode.signals["force/servo"])
    mixed = replace(episode, signals={**episode.signals, "force/servo": force}, off_tick=np.where(first, -1e-4, 0.0))
    replayer = Replayer(plant, [mixed], 0.4, ["force/servo"])
    size = np.abs(force).max()
    error = np.abs(replayer.simulate([Change()])[0] - replayer.windows.measured)
    assert np.median(error) < 0.02 * size and np.quantile(error, 0.9) < 0.04 * size
    wrong = np.abs(replayer.with_forces_read(AFTER).simulate([Change()])[0] - replayer.windows.measured)
    assert np.quantile(wrong, 0.9) > 0.08 * size


@pytest.mark.parametrize("unsure", [False, True])
def test_a_force_may_have_been_read_before_its_command(servo, unsure: bool) -> None:
    plant, episode, _ = servo
    episode = replace(episode, off_tick=np.nan if unsure else 0.0)
    replayer = Replayer(plant, [episode], 0.4, ["qpos/x", "force/servo"])
    _, floor, doubt = discrepancy(replayer, [], [])
    w, jump = replayer.windows, 4000.0 * np.diff(episode.ctrl[:, 0], prepend=0.0)
    jumps = np.array([jump[s + 1 : s + 1 + w.samples] for s in w.start])
    often, always = (np.abs(jumps) / 2, 0 * jumps) if unsure else (0 * jumps, jumps)
    near = 0.05 * np.abs(jumps).max()
    np.testing.assert_allclose(doubt[..., 1], often, atol=near)
    np.testing.assert_allclose(floor[1, ..., 1], always, atol=near)
    assert not doubt[..., 0].any() and not floor[1, ..., 0].any()
    problem = prepare(plant, [episode], [], window=0.3, signals=None, held_out=None).problem
    assert (np.median(problem.scale[..., 1]) > 0.3 * np.median(np.abs(jumps))) == unsure


@pytest.mark.parametrize("sharp", [False, True])
def test_a_sensor_is_read_when_the_state_is(sharp: bool) -> None:
    scene = SLIDE.replace("</mujoco>", '<sensor><jointpos name="p" joint="x"/></sensor></mujoco>')
    plant, episode = Plant(mujoco.MjSpec.from_string(scene)), _sine()
    signals = {**episode.signals, "sensor/p": episode.signals["qpos/x"]}
    replayer = Replayer(
        plant.sharper() if sharp else plant, [Episode("p", 0.001, episode.ctrl, signals)], 0.5, ["sensor/p"]
    )
    error = replayer.simulate([Change()])[0] - replayer.windows.measured
    assert np.abs(error).max() < 3e-6  # a step late it would be 1e-4 m and more


def test_in_sharper_steps_dry_friction_turns_at_once() -> None:
    """m q'' = F - f sign(q'), from v > 0: by hand it stops at t = m v / (f - F), and goes back with (F + f) / m."""
    m, f, push, v = 2.0, 3.0, -30.0, 0.1
    scene = SLIDE.replace('axis="1 0 0"', f'axis="1 0 0" frictionloss="{f}"')
    turn = m * v / (f - push)
    t = np.arange(1, 51) * 0.002
    q = np.where(t < turn, v * t + (push - f) / m * t**2 / 2, v * turn / 2 + (push + f) / m * (t - turn) ** 2 / 2)
    episode = Episode("turn", 0.002, np.full((100, 1), push), {"qpos/x": np.linspace(0, 1, 100) ** 2})
    errors = []
    for plant in (Plant(mujoco.MjSpec.from_string(scene)), Plant(mujoco.MjSpec.from_string(scene)).sharper()):
        replayer = Replayer(plant, [episode], 0.1, ["qpos/x"])
        w = replayer.windows
        replayer.windows = w._replace(q0=np.zeros((1, 1)), v0=np.full((1, 1), v), a0=np.full((1, 1), (push - f) / m))
        errors.append(np.abs(replayer.simulate([Change()])[0, 0, :, 0] - q).max())
    assert errors[1] < 2e-4 < 6e-4 < errors[0]


def test_effects_in_one_batch_do_not_disturb_each_other(plant) -> None:
    replayer = Replayer(plant, [_sine()], 0.5, ["qpos/x"])
    terms = candidates(plant, {("geom", "geom0"): TypicalSizes()}, None)
    changes = [t.build(t.starts[0]) for t in terms]
    together = replayer.simulate([*changes, Change()])
    for change, values in zip(changes, together[:-1], strict=True):
        np.testing.assert_array_equal(replayer.simulate([change])[0], values)


def test_models_whose_arrays_differ_are_never_rolled_out_together() -> None:
    """A friction of two directions adds an actuator without an input, a load on another body other sparse blocks."""
    arm = Plant(mujoco.MjSpec.from_string(TWO_LINKS))
    scales = {("joint", "elbow"): TypicalSizes(), ("body", "upper"): TypicalSizes(), ("body", "lower"): TypicalSizes()}
    rubs, upper, lower = (
        make_term(arm, name, place, scales[kind, place])
        for name, kind, place in (
            ("asymmetric_friction", "joint", "elbow"),
            ("payload", "body", "upper"),
            ("payload", "body", "lower"),
        )
    )
    for changes in ([Change(), rubs.build(np.array([1.0, 2.0]))], [t.build(np.ones(1)) for t in (upper, lower)]):
        models = [arm.compile(c) for c in changes]
        sizes = {(m.nq, m.nv, m.nu, m.na, m.nbody, m.ntendon, m.neq, m.nM, m.npair) for m in models}
        assert len(sizes) == 1 and _same_layout(models, changes) == [[0], [1]]
        assert _same_layout([models[1]] * 2, [changes[1]] * 2) == [[0, 1]]


def test_an_effect_that_has_no_place_here_is_refused(plant) -> None:
    with pytest.raises(UserError, match="contact_friction: it needs geoms that touch"):
        candidates(plant, {}, ["viscous_friction", "contact_friction"])


def test_every_effect_of_the_table_is_known_and_neutral_at_its_neutral_value(plant) -> None:
    replayer = Replayer(plant, [_sine()], 0.5, ["qpos/x"])
    nominal = replayer.simulate([Change()])[0]
    for name in TABLE:
        place = {"joint": "x", "actuator": "motor", "body": "cart", "signal": "qpos/x", "geom": "geom0"}.get(
            __import__(f"envs.effects.{name}", fromlist=["EFFECT"]).EFFECT.place, ""
        )
        term = make_term(plant, name, place, TypicalSizes(peak=5.0))
        same = replayer.simulate([term.build(np.clip(term.neutral, term.low, term.high))])[0]
        np.testing.assert_allclose(same, nominal, atol=1e-6, err_msg=name)


TWO_LINKS = """<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0"/>
<geom size="0.05" pos="0.3 0 0" mass="1"/><body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/>
<geom size="0.05" pos="0.3 0 0" mass="1"/></body></body></worldbody>
<actuator><motor name="first" joint="shoulder"/><motor name="second" joint="elbow"/></actuator></mujoco>"""
SHARED = """<mujoco><worldbody><geom name="wall" type="plane" size="2 2 1" friction="0.3"/>
<geom name="far" type="box" size="1 1 1" pos="9 9 9"/><body name="x"><joint name="x" type="slide" axis="1 0 0"/>
<geom name="x" size="0.1" mass="2" friction="0.4"/></body></worldbody>
<actuator><motor name="x" joint="x"/></actuator></mujoco>"""


def test_some_start_of_a_saturation_is_within_a_factor_of_two_of_any_limit(plant) -> None:
    term = make_term(plant, "torque_saturation", "motor", TypicalSizes(peak=8.0))
    for limit in np.linspace(0.1, 1.0, 19) * 8.0:
        assert any(0.5 <= float(s[0]) / limit <= 2.0 for s in term.starts), limit


def test_what_shares_a_name_keeps_its_own_size_and_what_touches_is_found() -> None:
    plant = Plant(mujoco.MjSpec.from_string(SHARED))
    at = typical_sizes(plant, Replayer(plant, [_sine()], 0.5, ["qpos/x"]))
    rms = float(np.sqrt(np.mean(_sine().ctrl ** 2)))
    assert abs(at["joint", "x"].force - 2 * rms) < 0.05 * rms  # the motor's and inertia's
    assert abs(at["actuator", "x"].command - rms) < 1e-6 and at["body", "x"].mass == 2.0
    assert {name: s.friction for (kind, name), s in at.items() if kind == "geom"} == {"x": 0.4}


def test_a_richer_effect_starts_as_the_simpler_one(plant) -> None:
    replayer = Replayer(plant, [_sine()], 0.5, ["qpos/x"])
    for rich, simple, value in (
        ("asymmetric_friction", "viscous_friction", 0.7),
        ("stribeck_friction", "coulomb_friction", 0.3),
    ):
        old, new = (make_term(plant, n, "x", TypicalSizes(), TABLE[n].variants[0]) for n in (simple, rich))
        a, b = replayer.simulate([old.build(np.array([value])), new.build(enrich(new, old, np.array([value]))[0])])
        np.testing.assert_allclose(a, b, atol=1e-7)


def test_friction_follows_the_load_of_the_simulation_and_not_of_the_recording(plant) -> None:
    """m q'' = F - c |F| sign(q') from rest, F = 4 and then -4: by hand a1 = (1 - c) F / m, a2 = (1 + c) F / m."""
    m, c, turn = 2.0, 0.25, 0.2
    t = np.arange(250) * 0.001
    ctrl = np.where(t < turn, 4.0, -4.0)
    still = Episode("still", 0.001, ctrl[:, None], {"qpos/x": 1e-3 * np.sin(50 * t)})  # a motion of its own
    replayer = Replayer(plant.sharper(), [still], 0.24, ["qpos/x"])
    begin = replayer.windows.start[0] * 0.001
    a1, a2 = (1 - c) * 4 / m, -(1 + c) * 4 / m
    replayer.windows = replayer.windows._replace(q0=np.zeros((1, 1)), v0=np.zeros((1, 1)), a0=np.full((1, 1), a1))
    friction = make_term(plant, "load_dependent_friction", "x", TypicalSizes()).build(np.array([c]))
    after = 0.001 * np.arange(1, replayer.windows.samples + 1)
    up, late = turn - begin, np.maximum(after - (turn - begin), 0)
    truth = np.where(after < up, a1 * after**2 / 2, a1 * up**2 / 2 + a1 * up * late + a2 * late**2 / 2)
    assert late[-1] < -a1 * up / a2  # it has not turned round yet
    np.testing.assert_allclose(replayer.simulate([friction])[0, 0, :, 0], truth, atol=2e-5)


def test_no_window_starts_where_smoothing_knows_one_side_only(plant) -> None:
    rng = np.random.default_rng(0)
    t = np.arange(1000) * 0.002
    apart = []
    for k in range(20):
        q = 0.1 * np.sin(15 * t + k) + 1e-3 * rng.standard_normal(len(t))
        replayer = Replayer(plant, [Episode(f"{k}", 0.002, np.zeros((1000, 1)), {"qpos/x": q})], 0.45, ["qpos/x"])
        true = 1.5 * np.cos(15 * t[replayer.windows.start] + k)
        apart += list((replayer.windows.v0[:, 0] - true) / replayer.smooth[0].v_sd[replayer.windows.start, 0])
    assert np.abs(apart).max() < 4  # at the very end it is up to 13


def test_a_start_at_a_corner_of_the_velocity_is_more_uncertain_than_elsewhere() -> None:
    t = np.arange(2000) * 0.002
    true = np.where(t % 1.0 < 0.5, 0.4, -0.4)
    q = np.cumsum(true) * 0.002 + 1e-4 * np.random.default_rng(0).standard_normal(len(t))
    s = smooth(Episode("a", 0.002, np.zeros((2000, 1)), {"qpos/x": q}), ["x"])
    off = (np.abs(s.v - true[:, None]) / s.v_sd)[s.half : -s.half]
    assert (off < 3).mean() > 0.97 and off.max() < 10  # at the corner, where the velocity jumps, it was up to 23
    assert s.v_sd[240:260].min() > 1.5 * s.v_sd[110:140].max()


def test_a_position_is_as_uncertain_as_its_smoothing_bends_it() -> None:
    t = np.arange(2000) * 0.002
    true = 0.1 * np.abs(np.sin(4 * t))  # bounces
    q = true + 1e-5 * np.random.default_rng(0).standard_normal(len(t))
    speed = 0.4 * np.cos(4 * t) * np.sign(np.sin(4 * t)) + 0.2 * np.random.default_rng(1).standard_normal(len(t))
    s = smooth(Episode("a", 0.002, np.zeros((2000, 1)), {"qpos/x": q, "qvel/x": speed}), ["x"])
    off = (np.abs(s.q[:, 0] - true) / s.q_sd[:, 0])[s.half : -s.half]
    assert (off < 3).mean() > 0.97 and off.max() < 10, (np.mean(off < 3), off.max())


def test_a_saturation_starts_near_what_the_motion_needs_however_much_was_asked() -> None:
    """A servo that is asked for 60 N all the time and gives 0.6: a hundredth, below all fixed starts."""
    scene = SLIDE.replace('<motor name="motor" joint="x"/>', '<position name="motor" joint="x" kp="60" kv="1"{}/>')
    limited = mujoco.MjModel.from_xml_string(scene.format(' forcerange="-0.6 0.6"'))
    data, q = mujoco.MjData(limited), []
    u = np.sign(np.sin(2 * 0.002 * np.arange(3000)))
    for command in u:
        q.append(data.qpos[0])
        data.ctrl[0] = command
        mujoco.mj_step(limited, data)
    plant = Plant(mujoco.MjSpec.from_string(scene.format("")))
    sizes = typical_sizes(
        plant, Replayer(plant, [Episode("a", 0.002, u[:, None], {"qpos/x": np.array(q)})], 0.5, ["qpos/x"])
    )
    term = make_term(plant, "torque_saturation", "motor", sizes["actuator", "motor"])
    assert sizes["actuator", "motor"].peak > 50
    assert min(abs(np.log(float(s[0]) / 0.6)) for s in term.starts) < np.log(1.5), term.starts
