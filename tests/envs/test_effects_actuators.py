"""Effects between the command and the machine, against the same world without them."""

import numpy as np
import pytest


def _at_rest(make_backend, **kwargs):
    """Pendulums that hang still at the bottom: nothing moves before a torque acts."""
    backend = make_backend("pendulum", kwargs.pop("num_envs", 1), **kwargs)
    backend.reset(np.arange(backend.num_envs))
    backend.qpos[:], backend.qvel[:] = np.pi, 0.0
    return backend


def _run(backend, actions) -> dict[str, np.ndarray]:
    """Joint-level record of all periods, {name: [N, T S, ...]}."""
    parts = []
    for action in actions:
        backend.send(np.broadcast_to(np.asarray(action, float), (backend.num_envs, backend.task.action_dim)))
        parts.append({k: v for k, v in backend._last.items() if k != "time"})
    return {key: np.concatenate([p[key] for p in parts], 1) for key in parts[0]}


def test_gain_scales_the_displacement(make_env, play) -> None:
    pushes = np.concatenate([np.ones((1, 1, 2)), np.zeros((6, 1, 2))])

    def displacement(gap):
        env = make_env("push", 1, effects_=gap, changes={"start_noise": 0.0})
        env.set_seed(0)
        return (play(env, pushes)["observation"][-1, 0, :2] - env.reset()["observation"][0, :2]).numpy()

    whole = displacement({})
    assert (whole > 0.04).all()
    # the arm's dry friction lets it stop some millimetres before its target
    np.testing.assert_allclose(displacement({"actuator_gain": {"gain": 0.5}}), 0.5 * whole, atol=0.004)
    np.testing.assert_allclose(
        displacement({"actuator_gain": {"gain": [0.3, -1.0]}}), [0.3 * whole[0], -whole[1]], atol=0.008
    )


def test_gain_scales_a_torque_exactly(make_backend) -> None:
    half = _run(_at_rest(make_backend, effects_={"actuator_gain": {"gain": 0.5}}), [1.0] * 5)
    same = _run(_at_rest(make_backend), [0.5] * 5)
    assert np.array_equal(half["qpos"], same["qpos"])


def test_offset_acts_when_nothing_is_asked(make_backend) -> None:
    drift = _run(_at_rest(make_backend, effects_={"actuator_offset": {"offset": 0.25}}), [0.0] * 5)
    same = _run(_at_rest(make_backend), [0.25] * 5)
    assert np.array_equal(drift["qpos"], same["qpos"]) and np.ptp(drift["qpos"]) > 0.01


def test_what_was_sent_is_told_before_the_hidden_effects(make_env, play) -> None:
    env = make_env("pendulum", 1, effects_={"actuator_gain": {"gain": 0.5}, "actuator_offset": {"offset": 0.1}})
    assert (play(env, np.full((2, 1, 1), 0.8))["action_sent"] == np.float32(0.8)).all()


@pytest.mark.parametrize("delay", [0.01, 0.05, 0.13, 0.5])
def test_a_delay_shifts_the_response_by_exactly_that(make_backend, delay) -> None:
    actions = [1.0, -0.3, 0.7, 0.2, 0.0, 0.0, 0.0, 0.0]
    now = _run(_at_rest(make_backend), actions)["qpos"]
    late = _run(_at_rest(make_backend, effects_={"actuator_delay": {"delay": delay}}), actions)["qpos"]
    steps = round(delay / 0.01)
    np.testing.assert_allclose(late[:, :steps], np.pi, atol=1e-12)
    assert (np.abs(late[:, steps + 1] - np.pi) > 1e-9).all()
    np.testing.assert_allclose(late[:, steps:], now[:, : now.shape[1] - steps], atol=1e-9)


def test_a_delay_of_part_of_a_physics_step_waits_for_the_next(make_backend) -> None:
    late = _run(_at_rest(make_backend, effects_={"actuator_delay": {"delay": 0.023}}), [1.0])["qpos"]
    now = _run(_at_rest(make_backend), [1.0])["qpos"]
    np.testing.assert_allclose(late[:, 3:], now[:, :-3], atol=1e-9)


def test_the_arm_answers_late_too(make_backend) -> None:
    def joints(gap):
        backend = make_backend("push", effects_=gap)
        backend.seed(0)
        backend.reset(np.arange(1))
        return _run(backend, [[1.0, 0.5]] * 3)["qpos"][0, :, :7]

    now, late = joints({}), joints({"actuator_delay": {"delay": 0.1}})  # 25 physics steps
    errors = {k: np.abs(late[k:] - now[: len(now) - k]).max() for k in (24, 25, 26)}
    assert errors[25] < 0.2 * min(errors[24], errors[26]), errors


def test_zero_delay_equals_no_delay(make_backend) -> None:
    actions = [1.0, -0.5, 0.3]
    none = _run(_at_rest(make_backend), actions)
    zero = _run(_at_rest(make_backend, effects_={"actuator_delay": {"delay": 0.0}}), actions)
    drawn = {"latency": {"fields": ["actuator_delay"], "operation": "set", "low": 0.0, "high": 0.0}}
    drawn = _run(_at_rest(make_backend, draws=drawn), actions)
    for other in (zero, drawn):
        np.testing.assert_allclose(other["qpos"], none["qpos"], atol=1e-12)
        np.testing.assert_allclose(other["force"], none["force"], atol=1e-12)


@pytest.mark.parametrize("gap", [{"actuator_delay": {"delay": 0.5}}, {"actuator_lag": {"time_constant": 0.5}}])
def test_history_and_filter_start_filled_with_the_first_command(make_backend, gap) -> None:
    """MuJoCo's start at zero, which would throw the arm towards its zero posture."""
    backend = make_backend("push", 2, effects_=gap)
    backend.reset(np.arange(2))
    start = backend.qpos[:, :7].copy()
    moved = _run(backend, [[0.0, 0.0]] * 4)["qpos"][:, :, :7]
    assert np.abs(moved - start[:, None]).max() < 0.01
    np.testing.assert_allclose(backend._last["ctrl"][:, 0], backend._last["ctrl"][:, -1], atol=1e-6)


@pytest.mark.parametrize("tau", [0.03, 0.2])
def test_lag_answers_a_ramp_as_a_first_order_filter_does(make_backend, tau) -> None:
    backend = _at_rest(make_backend, effects_={"actuator_lag": {"time_constant": tau}})
    force = _run(backend, [1.0, 1.0, 1.0])["force"][0, :, 0]
    top, period, dt = backend.task.max_torque, 0.1, 0.01
    t = dt * np.arange(1, 31)
    rise = top / period * (t - tau * (1 - np.exp(-t / tau)))  # answer to the ramp
    at_end = top / period * (period - tau * (1 - np.exp(-period / tau)))
    hold = top + (at_end - top) * np.exp(-(t - period) / tau)
    # the ramp is a staircase of one physics step: half a step early
    np.testing.assert_allclose(force, np.where(t <= period, rise, hold), atol=0.5 * dt * top / period)


def test_lag_of_a_held_command_decays_exactly(make_backend) -> None:
    tau = 0.15
    backend = _at_rest(make_backend, effects_={"actuator_lag": {"time_constant": tau}})
    missing = backend.task.max_torque - _run(backend, [1.0, 1.0, 1.0])["force"][0, 10:, 0]
    np.testing.assert_allclose(missing[1:] / missing[:-1], np.exp(-0.01 / tau), rtol=1e-6)


def test_delay_and_lag_add_up(make_backend) -> None:
    lag = {"actuator_lag": {"time_constant": 0.1}}
    early = _run(_at_rest(make_backend, effects_=lag), [1.0, -1.0, 0.5])["qpos"]
    late = _run(_at_rest(make_backend, effects_=lag | {"actuator_delay": {"delay": 0.07}}), [1.0, -1.0, 0.5])["qpos"]
    np.testing.assert_allclose(late[:, 7:], early[:, :-7], atol=1e-9)


def test_state_torque_against_an_independent_integration(make_backend) -> None:
    from scipy.integrate import solve_ivp

    e = {"amplitude": 4.0, "phase": 0.8, "rate": -0.3}
    inertia = 1.0 * (1.0**2 + 0.4 * 0.08**2)  # point mass on the rod plus the bob's own sphere

    def motion(t, state, with_effect):
        angle, speed = state
        torque = 9.81 * np.sin(angle) - 0.05 * speed
        if with_effect:
            torque += e["amplitude"] * np.sin(angle + e["phase"]) + e["rate"] * speed
        return [speed, torque / inertia]

    ends = {}
    for with_effect in (False, True):
        backend = make_backend(
            "pendulum", effects_={"state_torque": e} if with_effect else {}, changes={"sim_dt": 0.0005}
        )
        backend.reset(np.arange(1))
        backend.qpos[:], backend.qvel[:] = 2.0, 0.5
        _run(backend, [0.0] * 8)
        ends[with_effect] = solve_ivp(motion, (0, 0.8), [2.0, 0.5], args=(with_effect,), rtol=1e-9, atol=1e-9).y[:, -1]
        np.testing.assert_allclose([backend.qpos[0, 0], backend.qvel[0, 0]], ends[with_effect], atol=0.01)
    assert np.abs(ends[True] - ends[False]).max() > 0.3
