"""Every effect fits every machine: nothing changes at zero, the scene keeps its order, plain MJCF shows the same."""

import importlib
import math

import mujoco
import numpy as np
import pytest

from envs import effects
from envs.effects import Effect, available

HEAD = '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
LINK = '<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1"/>'
PLANTS = {
    "slide": f"""{HEAD}<worldbody>
        <body><joint name="slide" type="slide" axis="1 0 0" damping="1"/><geom size="0.1" mass="2"/></body>
      </worldbody><actuator><motor name="pull" joint="slide"/></actuator></mujoco>""",
    "servo pendulum": f"""{HEAD}<worldbody>
        <body><joint name="hinge" axis="0 1 0" range="-170 170" frictionloss="0.1" armature="0.05"/>{LINK}</body>
      </worldbody><actuator><position name="servo" joint="hinge" kp="100" dampratio="1" inheritrange="1"/></actuator>
      </mujoco>""",
    "two-link arm": f"""{HEAD}<worldbody>
        <body name="upper"><joint name="shoulder" axis="0 1 0" stiffness="2" springref="20"/>{LINK}
          <body name="fore" pos="0.4 0 0"><joint name="elbow" axis="0 1 0"/>{LINK}</body>
        </body>
      </worldbody>
      <actuator><motor name="s" joint="shoulder" gear="5"/><motor name="e" joint="elbow" ctrlrange="-2 2"/></actuator>
      </mujoco>""",
    "cart-pole": f"""{HEAD}<worldbody>
        <geom name="floor" type="plane" size="5 5 0.1" pos="0 0 -1"/>
        <body><joint type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
          <body><joint axis="0 1 0"/>{LINK}</body>
        </body>
        <body name="loose" pos="0 1 -0.9"><freejoint/><geom name="loose" size="0.1" mass="0.1"/></body>
      </worldbody><actuator><general name="push" joint="cart" gainprm="8"/></actuator></mujoco>""".replace(
        '<joint type="slide"', '<joint name="cart" type="slide"'
    ),
    "with defaults": f"""{HEAD}<default>
        <joint damping="1" frictionloss="0.2" armature="0.02" stiffness="0.5"/><motor gear="4"/>
        <tendon stiffness="5" damping="1" frictionloss="0.5"/>
      </default><worldbody><body><joint name="hinge" axis="0 1 0"/>{LINK}</body></worldbody>
      <actuator><motor name="m" joint="hinge"/></actuator></mujoco>""",
    "arm and puck": None,
}
WRITTEN_OUT = f"""{HEAD}<worldbody><body>
        <joint name="hinge" axis="0 1 0" damping="1" frictionloss="0.2" armature="0.02" stiffness="0.5"/>{LINK}
      </body></worldbody><actuator><motor name="m" joint="hinge" gear="4"/></actuator></mujoco>"""
NO_ZERO = {"actuator_delay", "actuator_lag", "contact_friction", "payload"}  # add a state or a body, or set a value
SIZES = {  # clearly different from nothing, for any of the plants
    "actuator_delay": {"delay": 0.02},
    "actuator_gain": {"gain": 0.5},
    "actuator_lag": {"time_constant": 0.05},
    "actuator_offset": {"offset": 0.2},
    "armature": {"inertia": 0.5},
    "asymmetric_friction": {"forward": 2.0, "backward": 1.0},
    "backlash": {"gap": 0.02},
    "contact_softness": {"time_constant": 0.1},
    "coulomb_friction": {"torque": 0.3},
    "flexible_joint": {"compliance": 0.02},
    "gravity_tilt": {"angle": 0.2, "roll": 0.1},
    "joint_stiffness": {"stiffness": 3.0, "rest": 0.2},
    "quadratic_drag": {"coefficient": 1.0},
    "stribeck_friction": {"coulomb": 0.2, "static": 0.4, "velocity": 0.1},
    "torque_saturation": {"limit": 0.2},
    "viscous_friction": {"coefficient": 1.0},
}


def _kind(name: str) -> type[Effect]:
    return importlib.import_module(f"envs.effects.{name}").EFFECT


NATIVE = [name for name in available() if _kind(name).native]


def _scene(plant: str, make_task) -> mujoco.MjSpec:
    text = PLANTS[plant]
    return make_task("push").spec() if text is None else mujoco.MjSpec.from_string(text)


def _move(model: mujoco.MjModel, nominal: mujoco.MjModel, steps: int = 60) -> np.ndarray:
    """Positions [T, nq of the nominal model] under a wave on every control."""
    data = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    data.qvel[: nominal.nv] = 0.1
    if model.nq > 20:  # the arm, bent
        data.qpos[:7] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785]
    effects.place_rotors(model, data.qpos, data.qvel)
    rest, moved = data.qpos[: nominal.nu].copy() if nominal.nu == 7 else 0.0, []
    if len(lags := [a for a in model.actuator_actadr[: nominal.nactuator] if a >= 0]):
        data.act[lags] = rest
    for k in range(steps):
        data.ctrl[:] = rest + 0.4 * np.sin(0.1 * k + np.arange(nominal.nu))
        mujoco.mj_step(model, data)
        moved.append(data.qpos[: nominal.nq].copy())
    return np.array(moved)


def _edited(spec: mujoco.MjSpec, name: str, parameters: dict) -> mujoco.MjSpec:
    copy = spec.copy()
    effects.load({name: parameters})[0].edit_spec(copy)
    return copy


def _at(spec: mujoco.MjSpec, name: str) -> dict:
    """An `at` for effects that have no sensible default outside of pushing."""
    if name in ("actuator_gain", "actuator_offset"):
        return {"at": [a.name for a in spec.actuators]}
    if name == "payload":
        return {"at": [b.name for b in spec.bodies if b.name and b.name != "world"][-1:]}
    return {"at": [g.name for g in spec.geoms if g.name][-1:]} if name == "contact_friction" else {}


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", sorted(set(available()) - NO_ZERO))
def test_zero_changes_nothing_bit_for_bit(make_task, plant, name) -> None:
    spec = _scene(plant, make_task)
    nominal = spec.copy().compile()
    model = _edited(spec, name, {}).compile()
    assert np.array_equal(_move(model, nominal), _move(nominal, nominal))


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", sorted(set(NATIVE) & set(SIZES)))
def test_an_effect_fits_the_scene_and_its_mjcf(make_task, plant, name) -> None:
    spec = _scene(plant, make_task)
    nominal = spec.copy().compile()
    edited = _edited(spec, name, SIZES[name] | _at(spec, name))
    model = edited.compile()
    assert model.nu == nominal.nu
    for kind, count in (("joint", nominal.njnt), ("actuator", nominal.nactuator), ("body", nominal.nbody)):
        for i in range(count):  # what the scene had keeps its number; what had no name may have got one
            own = getattr(nominal, kind)(i).name
            assert not own or getattr(model, kind)(i).name == own
    moved, plain = _move(model, nominal), _move(nominal, nominal)
    assert np.isfinite(moved).all()
    if name != "contact_softness":
        assert np.abs(moved - plain).max() > 1e-6
    reloaded = mujoco.MjModel.from_xml_string(edited.to_xml())
    np.testing.assert_allclose(_move(reloaded, nominal), moved, atol=1e-6)


NATIVE_SIZES = [(name, SIZES[name]) for name in sorted(set(NATIVE) & set(SIZES))]
NATIVE_SIZES += [("stribeck_friction", SIZES["stribeck_friction"] | {"deflection": 0.001})]


@pytest.mark.parametrize(("name", "size"), NATIVE_SIZES)
def test_what_an_effect_adds_takes_nothing_of_the_scene_s_defaults(make_task, name, size) -> None:
    moved = []
    for spec in (_scene("with defaults", make_task), mujoco.MjSpec.from_string(WRITTEN_OUT)):
        nominal = spec.copy().compile()
        moved.append(_move(_edited(spec, name, size | _at(spec, name)).compile(), nominal))
    assert np.array_equal(*moved)


@pytest.mark.parametrize(("name", "size"), NATIVE_SIZES)
def test_a_joint_s_limit_of_its_drive_is_no_limit_of_what_else_acts_there(name, size) -> None:
    """`actuatorfrcrange`, which URDFs give joints, as much as a range of the drive."""
    drive, joint = '<motor name="m" joint="hinge" gear="-2"{}/>', '<joint name="hinge" axis="0 1 0"{}/>'
    scene = f"{HEAD}<worldbody><body>{joint}{LINK}</body></worldbody><actuator>{drive}</actuator></mujoco>"
    moved = []
    for limit, reach in ((' actuatorfrcrange="-0.3 0.2"', ""), ("", ' forcerange="-0.1 0.15"')):
        spec = mujoco.MjSpec.from_string(scene.format(limit, reach))
        nominal = spec.copy().compile()
        moved.append(_move(_edited(spec, name, size | _at(spec, name)).compile(), nominal))
    np.testing.assert_allclose(*moved, atol=1e-9)


def test_drives_that_share_a_limit_are_told_to_have_their_own() -> None:
    drives = '<actuator><motor name="a" joint="hinge"/><motor name="b" joint="hinge"/></actuator></mujoco>'
    joint = '<joint name="hinge" axis="0 1 0" actuatorfrcrange="-1 1"/>'
    spec = mujoco.MjSpec.from_string(f"{HEAD}<worldbody><body>{joint}{LINK}</body></worldbody>{drives}")
    with pytest.raises(ValueError, match="asymmetric_friction: the drives a, b share the limit of 'hinge'"):
        _edited(spec, "asymmetric_friction", {"forward": 1.0})


def test_a_rotor_does_not_swim() -> None:
    scene = f"""{HEAD.replace("timestep", 'density="1000" viscosity="0.001" timestep')}<worldbody><body>
        <joint name="hinge" axis="0 0 1"/>{LINK}</body></worldbody>
      <actuator><motor name="m" joint="hinge"/></actuator></mujoco>"""
    speeds = []
    for name, size in (("flexible_joint", {}), ("flexible_joint", {"compliance": 1e-4}), ("backlash", {"gap": 1e-4})):
        model = _edited(mujoco.MjSpec.from_string(scene), name, size).compile()
        data = mujoco.MjData(model)
        data.ctrl[:] = 1.0
        mujoco.mj_step(model, data, 500)
        speeds.append(data.qvel[0])
    assert speeds[1] == pytest.approx(speeds[0], rel=0.01) and speeds[2] == pytest.approx(speeds[0], rel=0.01)


@pytest.mark.parametrize("own", ["", 'timeconst="0.1"', 'timeconst="0.1" delay="0.1" nsample="60"'])
def test_a_lag_and_a_delay_add_to_those_of_the_actuator(own) -> None:
    servo = f'<actuator><position name="servo" joint="hinge" kp="1" {own}/></actuator></mujoco>'
    spec = mujoco.MjSpec.from_string(
        f'{HEAD}<worldbody><body><joint name="hinge" axis="0 1 0"/>{LINK}</body></worldbody>{servo}'
    )
    before = spec.copy().compile()
    model = _edited(_edited(spec, "actuator_lag", {"time_constant": 0.05}), "actuator_delay", {"delay": 0.02}).compile()
    assert model.actuator_dynprm[0, 0] == pytest.approx(0.05 + (0.1 if own else 0.0))
    assert model.actuator_delay[0] == pytest.approx(before.actuator_delay[0] + 0.02)
    assert model.actuator_history[0, 0] > model.actuator_delay[0] / model.opt.timestep


def test_a_muscle_has_no_lag_added() -> None:
    spec = mujoco.MjSpec.from_string(
        f'{HEAD}<worldbody><body><joint name="hinge" axis="0 1 0"/>{LINK}</body></worldbody>'
        '<actuator><muscle name="m" joint="hinge" lengthrange="0.1 1"/></actuator></mujoco>'
    )
    with pytest.raises(ValueError, match="actuator_lag: actuator 'm' is not linear"):
        _edited(spec, "actuator_lag", {"time_constant": 0.05})


@pytest.mark.parametrize("dmax", [0.5, 0.95])
def test_softness_is_the_same_of_a_contact_told_by_stiffness_and_damping(dmax) -> None:
    """MuJoCo's b is 2 / (dmax time) or -solref[1] / dmax, its k 1 / (dmax time ratio)^2 or -solref[0] / dmax^2."""
    told = mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><geom name="g" size="0.1" solref="{{}}" solimp="0.4 {dmax}"/></worldbody></mujoco>'.format(
            f"{-1 / 0.02**2} {-2 / 0.02}"
        )
    )
    soft = _edited(told, "contact_softness", {"time_constant": 0.02}).compile()
    np.testing.assert_allclose(soft.geom_solref[0], [-1 / 0.04**2, -2 / 0.04])


def test_a_contact_without_damping_is_not_softened() -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><geom name="g" size="0.1" solref="-900 0"/></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match="the contacts of geom 'g' have no damping"):
        _edited(spec, "contact_softness", {"time_constant": 0.02})


@pytest.mark.parametrize("how", ["", 'inertiafromgeom="false"', 'inertiafromgeom="true"', 'inertiagrouprange="2 3"'])
def test_a_load_weighs_what_it_does_however_masses_are_inferred(how) -> None:
    inertial = '<inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
    link = LINK.replace("<geom", '<geom group="3"')
    body = f'<body name="arm"><joint name="hinge" axis="0 1 0"/>{inertial}{link}</body>'
    scene = f"<mujoco><compiler {how}/><worldbody>{body}</worldbody></mujoco>"
    spec = mujoco.MjSpec.from_string(scene)
    edited = _edited(spec, "payload", {"mass": 2.0, "at": ["arm"]})
    for model in (edited.compile(), mujoco.MjModel.from_xml_string(edited.to_xml())):
        assert model.body_mass.sum() - spec.copy().compile().body_mass.sum() == pytest.approx(2.0)


@pytest.mark.parametrize("plant", PLANTS)
def test_bristles_fit_the_scene_and_its_mjcf(make_task, plant) -> None:
    spec = _scene(plant, make_task)
    nominal = spec.copy().compile()
    edited = _edited(spec, "stribeck_friction", SIZES["stribeck_friction"] | {"deflection": 0.001})
    model = edited.compile()
    assert model.nu == nominal.nu and model.na > nominal.na
    moved = _move(model, nominal)
    assert np.isfinite(moved).all() and np.abs(moved - _move(nominal, nominal)).max() > 1e-6
    np.testing.assert_allclose(_move(mujoco.MjModel.from_xml_string(edited.to_xml()), nominal), moved, atol=1e-6)


@pytest.mark.parametrize("name", sorted(set(NATIVE) & set(SIZES)))
def test_an_effect_may_come_after_and_before_any_other(make_task, name) -> None:
    """All native effects at once, this one last and first: it compiles, moves and stays finite."""
    spec = _scene("two-link arm", make_task)
    nominal = spec.copy().compile()
    others = [n for n in SIZES if n != name]
    for order in ([name, *others], [*others, name]):
        scene = spec.copy()
        for each in order:
            effects.load({each: SIZES[each] | _at(spec, each)})[0].edit_spec(scene)
        assert np.isfinite(_move(scene.compile(), nominal)).all()


@pytest.mark.parametrize("name", sorted(set(NATIVE) & {n for n in SIZES if _kind(n).place == "joint"}))
def test_a_ball_or_free_joint_is_left_alone_or_refused(make_task, name) -> None:
    spec = _scene("cart-pole", make_task)
    spec.joints[-1].name = "free"
    assert _edited(spec, name, SIZES[name]).compile().dof_damping[-6:].tolist() == [0.0] * 6
    if name not in ("viscous_friction", "coulomb_friction"):
        with pytest.raises(ValueError, match="'free' is a ball or free"):
            _edited(spec, name, SIZES[name] | {"at": ["free"]})


def test_rotors_start_where_their_joints_are(make_task) -> None:
    spec = _scene("two-link arm", make_task)
    model = _edited(spec, "backlash", {"gap": 0.1}).compile()
    qpos, qvel = np.array([[0.3, -0.4, 9.0, 9.0]]), np.array([[1.0, 2.0, 9.0, 9.0]])
    effects.place_rotors(model, qpos, qvel)
    assert qpos.tolist() == [[0.3, -0.4, 0.3, -0.4]] and qvel.tolist() == [[1.0, 2.0, 1.0, 2.0]]


def test_rotors_lean_where_they_push() -> None:
    """Along a motion with play they are found at the flank where the simulation has them."""
    spec = mujoco.MjSpec.from_string(PLANTS["two-link arm"])
    model = _edited(spec, "backlash", {"gap": 0.02}).compile()
    data, apart = mujoco.MjData(model), []
    for k in range(3000):
        data.ctrl[:] = 0.5 * np.sin(0.006 * k + np.arange(2))
        mujoco.mj_step(model, data)
        if k > 500 and not k % 10:
            mujoco.mj_forward(model, data)
            qpos, qvel = data.qpos.copy()[None], data.qvel.copy()[None]
            effects.place_rotors(model, qpos, qvel, data.qacc[None])
            apart += list(np.abs(qpos[0, 2:] - data.qpos[2:]))
    assert np.mean(np.array(apart) < 0.002) > 0.8  # the rest is on its way from flank to flank


@pytest.mark.parametrize("name", sorted(set(SIZES) | {"deadband", "load_dependent_friction"}))
def test_a_gap_adds_nothing_to_what_a_task_records(make_backend, name) -> None:
    """Hidden joints and actuators must not give the gap away, nor shift what is recorded."""
    parameters = SIZES.get(name, {"width": 0.1} if name == "deadband" else {"coefficient": 0.1})
    backend, plain = make_backend("push", 2, effects_={name: parameters}), make_backend("push", 2)
    for each in (backend, plain):
        each.reset(np.arange(2))
        each.send(np.full((2, 2), 0.5))
        each.reset(np.array([1]))
    assert backend.describe() == plain.describe()
    assert {k: v.shape for k, v in backend.samples().items()} == {k: v.shape for k, v in plain.samples().items()}


def test_places_and_natives_are_told() -> None:
    places = {name: _kind(name).place for name in available()}
    assert set(places.values()) == {"", "joint", "actuator", "body", "geom", "tendon", "signal"}
    hooks = ("command", "ctrl", "force", "friction", "sense")
    for name in available():
        acts = [h for h in hooks if getattr(_kind(name), h) is not getattr(Effect, h)]
        assert _kind(name).native == (not acts or name in ("actuator_gain", "actuator_offset")), (name, acts)
        assert _kind(name)().native is _kind(name).native


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (
            {"asymmetric_friction": {"forward": -1.0}},
            "AsymmetricFriction.forward=-1.0 N m s/rad or N s/m: allowed are 0",
        ),
        ({"stribeck_friction": {"velocity": 0.0}}, "StribeckFriction.velocity=0.0 rad/s or m/s: allowed are 1e-06"),
        ({"load_dependent_friction": {"coefficient": 1.5}}, "LoadDependentFriction.coefficient=1.5"),
        ({"quadratic_drag": {"coefficient": math.nan}}, "QuadraticDrag.coefficient=nan"),
        ({"armature": {"inertia": -0.1}}, "Armature.inertia=-0.1 kg m^2 or kg"),
        ({"torque_saturation": {"limit": 0.0}}, "TorqueSaturation.limit=0.0 N m or N"),
        ({"deadband": {"width": 1.5}}, "Deadband.width=1.5 of the largest action"),
        ({"actuator_offset": {"offset": [0.0, -1.5]}}, "of the largest action: allowed are -1.0 to 1.0"),
        ({"backlash": {"gap": -0.01}}, "Backlash.gap=-0.01 rad or m"),
        ({"flexible_joint": {"compliance": -1.0}}, "FlexibleJoint.compliance=-1.0 rad/(N m) or m/N: allowed are 0.0"),
        ({"joint_stiffness": {"stiffness": -5.0}}, "JointStiffness.stiffness=-5.0"),
        ({"gravity_tilt": {"angle": 10.0}}, "GravityTilt.angle=10.0 rad"),
        ({"contact_softness": {"time_constant": 2.0}}, "ContactSoftness.time_constant=2.0 s"),
        ({"sensor_gain": {"gain": 9.0}}, "SensorGain.gain=9.0 1: allowed are -5.0 to 5.0"),
        (
            {"stribeck_friction": {"speed": 1.0}},
            "no parameter 'speed'. It has: coulomb, static, velocity, deflection, damping_ratio, at",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(effect, message) -> None:
    with pytest.raises(ValueError) as error:
        effects.load(effect)
    assert message in str(error.value)
