"""What deploy recorded tells the gap, which is never read; and what is told of folders that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml
from hydra.utils import instantiate

from envs.effects import load
from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.deployed import diagnose_run, unit_at, unit_of_signal
from mpc_sgft.diagnose.deployments.chain import Chain
from mpc_sgft.diagnose.deployments.command_link import ServoCommands, measured_drive, saturated
from mpc_sgft.diagnose.deployments.next_recording import repeated
from mpc_sgft.diagnose.deployments.recordings import as_rollout, joint_columns, read_deployment
from mpc_sgft.storage.episode_file import read_episode

SLIDE, HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
FEW = ["actuator_gain", "frame_rotation", "actuator_delay", "contact_friction"]


@pytest.mark.slow
def test_a_turned_and_weak_machine_is_named_and_repaired(deployed, tmp_path: Path, check_report) -> None:
    out = tmp_path / "out"
    run = deployed({"actuator_gain": {"gain": 0.7}, "frame_rotation": {"angle": 0.5, "at": "base"}})
    report = diagnose_run(run, out=out, effects=["actuator_gain", "frame_rotation", "actuator_delay"]).as_dict()
    check_report(report)
    assert report["verdict"] == "effect", report["reason"]
    found = {e["name"]: e for e in report["effects"]}
    assert set(found) == {"actuator_gain", "frame_rotation"} and found["frame_rotation"]["at"] == ["base"]
    assert abs(found["actuator_gain"]["parameters"]["gain"]["value"] - 0.7) < 0.01
    assert abs(found["frame_rotation"]["parameters"]["angle"]["value"] - 0.5) < 0.01
    assert report["held_out"]["low"] > 0.9
    mapping = yaml.safe_load((out / "effects.yaml").read_text())["effects"]
    assert {type(e).__name__ for e in load(mapping)} == {"ActuatorGain", "FrameRotation"}
    mujoco.MjModel.from_xml_path(str(out / "repaired.xml"))
    assert any("MJCF cannot carry it" in note for note in report["notes"])
    assert json.loads((out / "report.json").read_text()) == json.loads(json.dumps(report))
    page = (out / "report.html").read_text()
    assert "missing change of drive/" in page and "e-300" not in page, "the noise of a drive is not known"
    assert (out / "report.rrd").stat().st_size > 1000


def test_nothing_is_trained_on_a_part_of_what_is_missing(deployed, capsys) -> None:
    run = deployed({"actuator_gain": {"gain": 0.7}, "frame_rotation": {"angle": 0.5, "at": "base"}})
    summary = {"zero_shot_success": 0.0, "final_success": 0.0, "real_rollouts": 4, "curve": {"0": 0.0, "4": 0.0}}
    (run / "summary.json").write_text(json.dumps(summary))
    assert main(["--run", str(run), "--effects", "actuator_gain", "--max-effects", "1", "--retrain"]) == 0
    said = capsys.readouterr().out
    assert "Something is missing that no name in the library covers" in said
    assert "not retrained: what is missing is unknown" in said
    assert (run / "diagnosis" / "effects.yaml").exists() and not (run / "diagnosis" / "pretrain").exists()


def test_ice_is_named_by_how_far_the_puck_slides(deployed) -> None:
    run = deployed({"contact_friction": {"coefficient": 0.05, "at": ["puck"]}}, episodes=5)
    found = diagnose_run(run, effects=["actuator_gain", "contact_friction"])
    report = found.as_dict()
    (effect,) = report["effects"]
    assert report["verdict"] == "effect" and effect["name"] == "contact_friction", report["reason"]
    assert abs(effect["parameters"]["coefficient"]["value"] - 0.05) < 0.02
    puck = next(law for law in found.laws.laws if law.where == "observation/puck_x")
    ((_, went),) = puck.along
    assert np.polyfit(went, puck.before, 1)[0] > 0.1 > abs(np.polyfit(went, puck.after, 1)[0])  # further than foretold
    assert not any(law.where.startswith("drive") for law in found.laws.laws), "commands reach the servos as they are"


def test_one_joint_is_told_from_all_by_its_force(deployed, tmp_path: Path) -> None:
    run, out = deployed({"coulomb_friction": {"torque": 2.0, "at": ["joint4"]}}), tmp_path / "out"
    named = diagnose_run(run, effects=["coulomb_friction", "actuator_gain"], max_effects=2, out=out).as_dict()
    assert named["signals"][0]["signal"] == "qpos/joint4" and (out / "report.rrd").exists()
    assert "qpos/joint4: measured" not in (out / "report.html").read_text()  # its lines are forces and observations
    (effect,) = named["effects"]
    assert (named["verdict"], effect["name"], effect["at"]) == ("effect", "coulomb_friction", ["joint4"])
    assert effect["parameters"]["torque"]["unit"] == "N m"
    assert effect["parameters"]["torque"]["value"] == pytest.approx(2.0, abs=0.03)
    other = diagnose_run(run, effects=["actuator_gain"], max_effects=1).as_dict()
    assert other["verdict"] == "unknown" and "joint4" in other["reason"]


def test_a_little_friction_of_one_joint_is_not_too_faint(deployed) -> None:
    """No window's whole error is above what noise and contacts make, that of its joints is in all of them."""
    run = deployed({"coulomb_friction": {"torque": 0.3, "at": ["joint4"]}})
    report = diagnose_run(run, effects=["coulomb_friction"], max_effects=1).as_dict()
    (effect,) = report["effects"]
    assert (report["verdict"], effect["name"], effect["at"]) == ("effect", "coulomb_friction", ["joint4"])
    assert effect["parameters"]["torque"]["value"] == pytest.approx(0.3, abs=0.03)


def test_a_weak_drive_shows_as_a_slope_over_the_command(deployed) -> None:
    run = deployed({"actuator_gain": {"gain": 0.7}}, steps=20)  # later the arm is stretched, and elsewhere than meant
    found = diagnose_run(run, effects=["actuator_gain"])
    law = found.laws.laws[0]
    now, last = law.along
    assert law.where.startswith("drive/") and [now[0], last[0]] == [
        "commanded change",
        "commanded change, a step before",
    ]
    assert np.polyfit(now[1], law.before, 1)[0] == pytest.approx(-0.3, abs=0.25)
    assert law.after is not None and np.std(law.after) < 0.05 * np.std(law.before)


@pytest.mark.slow
def test_a_weak_arm_is_named_although_it_hammers_with_all_its_force(deployed) -> None:
    gap = {"actuator_gain": {"gain": 0.8}, "joint_stiffness": {"stiffness": 1000.0, "at": ["nail"]}}
    run = deployed(gap, episodes=6, steps=50, task_name="hammer")
    found = diagnose_run(run, effects=["actuator_gain", "deadband", "actuator_lag"])
    report, laws = found.as_dict(), found.laws.laws
    (effect,) = report["effects"]
    assert (report["verdict"], effect["name"]) == ("effect", "actuator_gain"), report["reason"]
    for law in (x for x in laws if x.where.startswith("drive/")):  # but for some blows, drawn as it is
        assert np.quantile(np.abs(law.before + 0.2 * law.along[0][1]), 0.9) < 0.01, law.where
    assert effect["parameters"]["gain"]["value"] == pytest.approx(0.8, abs=0.01)
    model = read_deployment(run).task.spec().compile()
    spent = np.concatenate([saturated(model, e) for e in read_deployment(run).episodes])
    assert spent[:, 1].mean() > 0.02, "its servos are at their limits when it strikes"


@pytest.mark.slow
def test_a_drift_of_the_hand_is_named_though_it_is_countered(deployed) -> None:
    drift = [-0.2, 0.3, 0.0]
    run = deployed({"actuator_offset": {"offset": drift}}, episodes=8, task_name="insert", against=drift)
    report = diagnose_run(run, effects=["actuator_offset", "actuator_gain", "frame_rotation"], max_effects=2).as_dict()
    (effect,) = report["effects"]
    assert (report["verdict"], effect["name"]) == ("effect", "actuator_offset"), report["reason"]
    found = [effect["parameters"][f"offset_{i}"]["value"] for i in (1, 2, 3)]
    np.testing.assert_allclose(found, drift, atol=0.01)


def test_only_what_hangs_on_a_motor_is_the_machine() -> None:
    for task, own in (("hammer", 7), ("insert", 7), ("push_towel", 7), ("walker_walk", 9)):
        cfg = compose("deploy", [f"task={task}"], [])
        made = instantiate(cfg.task.env, _convert_="all")
        assert len(joint_columns(made, "qpos")) == len(joint_columns(made, "qvel")) == own, task


def test_a_right_simulator_has_no_effect(deployed, check_report) -> None:
    report = diagnose_run(deployed({}), effects=FEW, max_effects=1).as_dict()
    check_report(report)
    assert report["verdict"] == "none" and report["effects"] == [], report["reason"]


def test_force_tells_what_reached_the_servos_and_the_recording_does_not(deployed) -> None:
    gap = {"actuator_gain": {"gain": 0.5}, "actuator_delay": {"delay": 0.1}, "actuator_lag": {"time_constant": 0.05}}
    run = deployed(gap, episodes=1)
    deployment = read_deployment(run)
    (episode,), task = deployment.episodes, deployment.task
    meant, true = ServoCommands(task, [episode]).drive([(), tuple(load(gap))])[:, 0, 1::2]  # [S, nu], as sampled
    drive = measured_drive(task.spec().compile(), episode)
    assert np.sqrt(np.mean((drive - true) ** 2)) < 1e-3 < 0.05 < np.sqrt(np.mean((drive - meant) ** 2))
    recorded = read_episode(run / "episodes" / "0001.mcap").joints["ctrl"]
    assert np.abs(recorded - meant).max() < 2e-3


@pytest.mark.parametrize("task_name", ["cheetah_run", "walker_walk"])
def test_a_right_simulator_foretells_motors_in_every_step(deployed, task_name: str) -> None:
    """The cheetah's control step is two physics steps, which no five samples divide; a torque is no place to go to."""
    chain = Chain(read_deployment(deployed({}, task_name=task_name)), 6, 16)
    everything = np.arange(len(chain.windows.start))
    assert (np.abs(chain.predict([()], everything).drive[0] - chain.drive) / chain.drive_scale).max() < 0.1
    assert chain.joint_scale.max() < 0.02  # [rad]; commands of noise are no noise of joints


def test_forces_belong_to_the_joints_of_the_machine_wherever_an_object_stands() -> None:
    arm = """<body name="link"><joint name="hinge"/><geom size="0.1" mass="1"/></body>"""
    puck = """<body name="puck" pos="1 0 0"><freejoint/><geom size="0.1" mass="1"/></body>"""
    t = np.linspace(0, 1, 51)
    for bodies in (arm + puck, puck + arm):
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><worldbody>{bodies}</worldbody>
            <actuator><position name="servo" joint="hinge" kp="10"/></actuator></mujoco>"""
        )
        q, u = np.sin(t)[:, None], 0.3
        episode = SimpleNamespace(time=t, q=q, v=0 * q, force=10 * (u - np.interp(t - 0.002, t, q[:, 0]))[:, None])
        assert measured_drive(model, episode) == pytest.approx(u)  # pyright: ignore[reportArgumentType]


def test_units_are_those_of_the_place() -> None:
    model = instantiate(compose("evaluate", ["task=cheetah_run"], []).task.env, _convert_="all").spec().compile()
    slide, hinge = (model.joint(int(np.flatnonzero(model.jnt_type == int(k))[0])).name for k in (SLIDE, HINGE))
    names = [f"qpos/{slide}", f"qpos/{hinge}", f"drive/{hinge}"]
    assert [unit_of_signal(model, n) for n in names] == ["m", "rad", "of the control"]
    unit = load({"actuator_offset": {}})[0].units["offset"]
    for at, words in (((), "of the largest action"), (("bthigh",), "of the control")):
        assert unit_at(model, SimpleNamespace(at=at), unit) == words  # pyright: ignore[reportArgumentType]


def test_actions_to_try_are_those_of_whole_episodes() -> None:
    action = np.random.default_rng(0).standard_normal((20, 7, 2))
    for count in (7, 2):
        tried = repeated(action[:, :count])
        assert all(any((tried[:, k] == action[:, e]).all() for e in range(count)) for k in range(tried.shape[1]))


def test_a_report_stays_with_the_run_that_was_meant(deployed, tmp_path: Path, monkeypatch) -> None:
    """runs/latest moves when another run begins, while the search takes minutes."""
    run, latest = deployed({}), tmp_path / "latest"
    latest.symlink_to(run)
    seen = []

    def moved(folder: Path, out: Path, **rest: object) -> None:
        latest.unlink()
        latest.symlink_to(tmp_path)
        seen.extend([folder.resolve(), out.resolve()])
        raise UserError("enough")

    monkeypatch.setattr("mpc_sgft.diagnose.deployed.diagnose_run", moved)
    assert main(["--run", str(latest)]) == 2
    assert seen == [run, run / "diagnosis"]


def test_a_cut_episode_is_read_as_far_as_it_is_whole(deployed) -> None:
    run = deployed({}, episodes=2)
    path = run / "episodes" / "0002.mcap"
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    deployment = read_deployment(run)
    assert [len(e.action) for e in deployment.episodes][0] == 40 and 10 < len(deployment.episodes[1].action) < 40
    assert "0002.mcap: it ends in the middle of a record" in deployment.notes[0]


def test_an_observation_that_is_no_number_is_named(deployed) -> None:
    run = deployed({}, episodes=4)
    task, path = read_deployment(run).task, next((run / "episodes").glob("*.mcap"))
    episode = read_episode(path)
    episode.transitions["next_observation"][11, 2] = np.nan
    with pytest.raises(UserError, match=f"episode {path.stem}: observation is not a number in step 12"):
        as_rollout(path.stem, episode, task)


def test_folders_that_are_no_deployment(tmp_path: Path, deployed) -> None:
    with pytest.raises(UserError, match="no such folder"):
        read_deployment(tmp_path / "nowhere")
    with pytest.raises(UserError, match="no config.yaml in it"):
        read_deployment(tmp_path)
    (tmp_path / "config.yaml").write_text("command: pretrain\n")
    with pytest.raises(UserError, match="pretrain wrote it. Only deployments hold real episodes"):
        read_deployment(tmp_path)
    (tmp_path / "config.yaml").write_text("command: deploy\n")
    with pytest.raises(UserError, match="names no task"):
        read_deployment(tmp_path)
    (tmp_path / "config.yaml").write_text("command: deploy\nbackend: {name: franka}\ntask: {env: {}}\n")
    with pytest.raises(UserError, match="an FR3 or its stand-in drove it.* --model ARM.xml --data"):
        read_deployment(tmp_path)
    run = deployed({}, episodes=1, steps=3)
    with pytest.raises(UserError, match="no episode has 10 whole steps. 0001.mcap: only 3 whole steps"):
        read_deployment(run)
    (run / "episodes" / "0001.mcap").write_bytes(b"not an episode")
    with pytest.raises(UserError, match="not an MCAP file"):
        read_deployment(run)
    (run / "episodes" / "0001.mcap").unlink()
    with pytest.raises(UserError, match="no episodes in"):
        read_deployment(run)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--model", "x.xml"], "--model does not go with --run"),
        (["--retrain"], "the deployment was not finished"),
        (["--retrain", "--retrain-transitions", "0"], "a whole number from 1 on"),
        (["--effects", "backlash"], "unknown effect 'backlash'"),
        (["--window", "-1"], "--window -1: the length of a simulated window is a number above 0"),
        (["--max-effects", "0"], "at least one effect must be allowed"),
    ],
)
def test_options_that_do_not_go_together(words: list[str], message: str, deployed, capsys) -> None:
    run = deployed({}, episodes=3, steps=30)
    assert main(["--run", str(run), *words]) == 2
    assert message in capsys.readouterr().err
