"""Every effect loads by its file's name, says its units, and refuses what makes no sense."""

import dataclasses
import importlib

import numpy as np
import pytest

from envs import effects

NAMES = effects.available()


def test_the_folder_holds_what_the_project_promises() -> None:
    promised = (
        "actuator_gain actuator_offset actuator_delay actuator_lag viscous_friction coulomb_friction payload "
        "contact_friction sensor_offset sensor_noise sensor_delay frame_rotation state_torque asymmetric_friction "
        "stribeck_friction load_dependent_friction quadratic_drag armature torque_saturation deadband backlash "
        "flexible_joint joint_stiffness gravity_tilt contact_softness sensor_gain directional_gain local_gain "
        "rope_length"
    )
    assert set(promised.split()) <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_contract_of_an_effect(make_env, play, random_actions, name) -> None:
    kind = importlib.import_module(f"envs.effects.{name}").EFFECT
    assert kind.__doc__ and importlib.import_module(f"envs.effects.{name}").__doc__
    numeric = {f.name for f in dataclasses.fields(kind) if f.name != "at"}
    assert set(kind.units) == numeric and set(kind.bounds) <= numeric
    with pytest.raises(dataclasses.FrozenInstanceError):
        kind().at = "elsewhere"
    task = "pendulum" if name == "state_torque" else "push"
    env = make_env(task, 2, effects_={name: {}})
    out = play(env, random_actions(3, 2, env.action_dim))
    assert np.isfinite(out["observation"].numpy()).all() and not out["invalid"].any()


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"contact_friction", "coulomb_friction", "payload"}))
def test_an_effect_of_zero_size_is_none(make_env, play, random_actions, name) -> None:
    task = "pendulum" if name == "state_torque" else "push"
    without, zero = make_env(task, 2), make_env(task, 2, effects_={name: {}})
    actions = random_actions(4, 2, without.action_dim)
    np.testing.assert_allclose(
        play(without, actions)["observation"].numpy(), play(zero, actions)["observation"].numpy(), atol=1e-7
    )


def test_bristles_are_an_effect_of_an_environment_that_a_reset_forgets(make_env, play, random_actions) -> None:
    gap = {"stribeck_friction": {"coulomb": 2.0, "static": 4.0, "velocity": 0.05, "deflection": 0.001}}
    bent, without = make_env("push", 2, effects_=gap), make_env("push", 2)
    actions = random_actions(4, 2, bent.action_dim)
    first, again, plain = (play(env, actions)["observation"].numpy() for env in (bent, bent, without))
    assert np.isfinite(first).all() and np.abs(first - plain).max() > 1e-4
    np.testing.assert_array_equal(first, again)


def test_an_unknown_effect_names_the_known_and_the_nearest() -> None:
    with pytest.raises(ValueError, match="No effect 'actuator_gian'.*Available: .*payload.*Did you mean actuator_gain"):
        effects.load({"actuator_gian": {}})


def test_an_effect_may_act_at_several_places() -> None:
    both = effects.load({"viscous_friction": [{"coefficient": 1.0, "at": ["a"]}, {"coefficient": 2.0, "at": ["b"]}]})
    assert [(e.coefficient, e.at) for e in both] == [(1.0, ("a",)), (2.0, ("b",))]  # pyright: ignore
    with pytest.raises(ValueError, match="has no parameter 'x'"):
        effects.load({"viscous_friction": [{"coefficient": 1.0}, {"x": 1.0}]})


def test_an_unknown_parameter_names_the_known() -> None:
    with pytest.raises(ValueError, match="actuator_delay has no parameter 'seconds'. It has: delay, at"):
        effects.load({"actuator_delay": {"seconds": 0.1}})


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ({"actuator_gain": {"gain": 50.0}}, "ActuatorGain.gain=50.0 1: allowed are -5.0 to 5.0"),
        ({"actuator_gain": {"gain": [0.5, 9.0]}}, "ActuatorGain.gain=9.0"),
        ({"actuator_delay": {"delay": -0.1}}, "ActuatorDelay.delay=-0.1 s: allowed are 0.0 to 2.0 s"),
        ({"sensor_noise": {"sd": float("nan")}}, "SensorNoise.sd=nan"),
        ({"payload": {"mass": "heavy"}}, "Effect payload: "),
        ({"actuator_gain": {"gain": None}}, "Effect actuator_gain: "),
        ({"frame_rotation": {"at": "table"}}, "'table'; allowed: base, camera"),
    ],
)
def test_values_out_of_bounds_are_refused(effect, message) -> None:
    with pytest.raises(ValueError) as error:
        effects.load(effect)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("task", "effect", "message"),
    [
        ("push", {"contact_friction": {"at": ["pucks"]}}, "No geom 'pucks' in this scene. Available: .*puck"),
        ("push", {"viscous_friction": {"at": "elbow"}}, "No joint 'elbow' in this scene. Available: joint1"),
        ("push", {"payload": {"at": ["link9"]}}, "No body 'link9' in this scene"),
        ("push", {"actuator_lag": {"at": ["motor"]}}, "No actuator 'motor' in this scene. Available: position1"),
        ("push", {"sensor_offset": {"at": ["tip_z"]}}, "push observes no 'tip_z'. It observes: tip_x, tip_y"),
        ("push", {"sensor_noise": {"at": ["tip_z"]}}, "push observes no 'tip_z'"),
        ("push", {"sensor_delay": {"at": ["tip_z"]}}, "push observes no 'tip_z'"),
        ("push", {"backlash": {"gap": 0.1, "at": ["puck"]}}, "joint 'puck' is a ball or free"),
        ("push", {"deadband": {"at": ["motor"]}}, "No actuator 'motor' in this scene. Available: position1"),
        ("push", {"load_dependent_friction": {"at": ["elbow"]}}, "No joint 'elbow' in this scene. Available: joint1"),
        ("push", {"sensor_gain": {"gain": [1, 1]}}, "sensor_gain.gain=.*2 numbers; give one, or 4"),
        ("push", {"torque_saturation": {"at": ["motor"]}}, "No actuator 'motor' in this scene"),
        ("push", {"rope_length": {"scale": 2.0}}, "rope_length.scale=2.0: this scene has no tendons"),
        ("rope_peg_in_hole", {"rope_length": {"at": ["rope9"]}}, "No tendon 'rope9' in this scene. Available: rope0"),
        ("push", {"actuator_gain": {"gain": [1, 1, 1]}}, "actuator_gain.gain=.*3 numbers; give one, or 2"),
        ("push", {"actuator_offset": {"offset": [0, 0, 0]}}, "actuator_offset.offset=.*3 numbers; give one, or 2"),
        ("push", {"directional_gain": {"negative": [1, 1, 1]}}, "directional_gain.negative=.*3 numbers"),
        (
            "push",
            {"local_gain": {"slope": 1.0, "at": "tip_z"}},
            "No observation 'tip_z' in this scene. Available: tip_x",
        ),
        ("push", {"sensor_offset": {"offset": [0, 0]}}, "sensor_offset.offset=.*2 numbers; give one, or 4"),
        ("pendulum", {"frame_rotation": {"at": "base"}}, "actions of pendulum are no displacements"),
        ("pendulum", {"frame_rotation": {"at": "camera"}}, "pendulum observes cos, sin, velocity, not points"),
    ],
)
def test_what_does_not_fit_the_task_stops_when_the_world_is_built(make_backend, task, effect, message) -> None:
    with pytest.raises(ValueError, match=message):
        make_backend(task, effects_=effect)


def test_the_base_cannot_be_turned_under_joint_control(make_backend) -> None:
    with pytest.raises(ValueError, match="no displacements"):
        make_backend("push", effects_={"frame_rotation": {"angle": 0.3}}, changes={"control": "joint"})


def test_a_single_name_needs_no_list() -> None:
    assert effects.load({"payload": {"at": "puck"}}) == effects.load({"payload": {"at": ["puck"]}})
