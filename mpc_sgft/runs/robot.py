"""From a config to a robot: the arm, its stand-in, what sees the object, and a rehearsal without moving."""

import json
from typing import Any

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from envs.backends.arm import Arm
from envs.backends.base import BackendError
from envs.backends.franka import FrankaBackend
from envs.backends.gripper import Gripper
from envs.backends.limits import Limits
from envs.backends.rig import Place, Rig
from envs.backends.safety import Gate
from envs.backends.stream import SAMPLE_DT
from envs.env import ControlEnv
from envs.perception.base import Perception, PerceptionError
from envs.stand_in.client import StandIn
from mpc_sgft.command.errors import UserError, from_config
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from mpc_sgft.runs.real_rollout import drive
from mpc_sgft.session.operator import Nobody, Operator
from mpc_sgft.storage import run_folder

STAND_IN = "stand-in"
NO_GRIPPER = {"width": None, "speed": 0.05, "force": 40.0}  # of runs from before there was the setting


def make_env(cfg: DictConfig, place: Place | None = None) -> ControlEnv:
    """The task on the robot of `cfg.backend`, not connected yet; what sees the object is opened on connecting.

    Args:
        cfg: The run's config.
        place: Has a person put the object somewhere; None asks for it in a line.

    Raises:
        UserError: For a task without a robot, a gap, a missing address, perception that does not go with it, a number
            that is not allowed, or a missing package.
    """
    place = place or Nobody().place
    on_robot = cfg.task.get("on_robot")
    if on_robot is None:
        raise UserError(f"task={cfg.chosen.task} cannot run on the robot: configs/task/ gives it no on_robot.")
    if cfg.gap.effects:
        raise UserError("a gap is what a simulator lacks; the robot has its own. Leave gap= out with --backend franka.")
    settings: Any = OmegaConf.to_container(cfg.backend, resolve=True)
    ip, clock = settings["robot_ip"], settings["clock"]
    if not cfg.rollouts and not settings["dry_run"]:
        raise UserError("rollouts=0: on a robot its rollouts are all that is measured. Give one or more.")
    if ip is None:
        raise UserError("--backend franka needs --robot-ip IP, or --robot-ip stand-in to rehearse without a robot.")
    if cfg.perception.name == "stand_in" and ip != STAND_IN:
        raise UserError(
            "perception=stand_in sees the stand-in's scene alone. Choose how the object is seen: perception=..."
        )
    if ip != STAND_IN and clock == "robot":
        raise UserError("backend.clock=robot is for the stand-in. A robot needs real time: leave backend.clock= out.")
    if ip == STAND_IN and cfg.perception.name != "stand_in":
        raise UserError(f"the stand-in has no camera for perception={cfg.perception.name}. Leave perception= out.")
    with from_config("task"):
        task = instantiate({**cfg.task.env, **on_robot}, _convert_="all")
    if task.arm is None:
        raise UserError(f"task={cfg.chosen.task} cannot run on the robot: its class gives it no arm.")
    with from_config("backend.limits"):
        limits = Limits(**settings["limits"])
    with from_config("backend.gripper"):
        gripper = Gripper(**settings.get("gripper", NO_GRIPPER))
    try:
        with from_config("backend.arm"):
            arm = Arm(str(ip), **settings["arm"])
    except BackendError as error:
        raise UserError(str(error)) from error

    def look() -> tuple[Perception, Place | None]:
        if ip == STAND_IN:
            stand_in = StandIn(task)
            arm.ip = stand_in.ip
            return stand_in, stand_in.scene.place
        with from_config("perception"):
            made = {key: value for key, value in cfg.perception.items() if key != "name"}
            return instantiate(made, _convert_="all"), place if cfg.perception.name != "fixed" else None

    with from_config("backend"):
        gate = Gate(limits, tool_length=task.arm.tool_length, sample_dt=SAMPLE_DT)
        clock = clock or ("robot" if ip == STAND_IN else "wall")
        patience, dry_run = settings["patience"], settings["dry_run"]
        rig = Rig(arm, look, gate, gripper=gripper, clock=clock, patience=patience, dry_run=dry_run)
        backend = FrankaBackend(task, rig, safe_tip=settings["safe_tip"], reset_speed=settings["reset_speed"])
    return ControlEnv(backend, history=cfg.task.history)


def connect(env: ControlEnv, operator: Operator) -> None:
    """Reach the robot, which an operator may stop from now on.

    Raises:
        UserError: Why not, and what to check.
    """
    try:
        env.backend.obey(operator.halt)  # type: ignore[attr-defined]
        operator.watch(env.backend.status)  # type: ignore[attr-defined]
        env.backend.open()  # type: ignore[attr-defined]
    except (BackendError, PerceptionError) as error:
        raise UserError(str(error)) from error


def dry_run(cfg: DictConfig, model: WorldModel, env: ControlEnv) -> int:
    """One episode in which the arm stays where it is: everything is measured, planned, checked and recorded."""
    folder = run_folder.start(cfg)
    (folder / "episodes").mkdir(exist_ok=True)
    build.prepare_process(cfg)
    try:
        rollout = drive(
            env,
            model,
            build.make_planner(cfg, env.action_dim),
            folder / "episodes" / "dry_run.mcap",
            number=0,
            seed=cfg.seed,
            noise=0.0,
            candidate_steps=(),
        )
    except BackendError as error:
        raise UserError(str(error)) from error
    assert rollout.plan_ms is not None
    summary = {
        "dry_run": True,
        "steps": len(rollout.plan_ms),
        "aborted": rollout.aborted,
        "planner_ms_median": round(float(np.median(rollout.plan_ms)), 1),
        "planner_ms_max": round(float(np.max(rollout.plan_ms)), 1),
        "first_observation": [round(float(x), 3) for x in rollout.steps["observation"][0, : env.raw_dim]],
        "robot": env.backend.report(),  # type: ignore[attr-defined]
    }
    run_folder.write_summary(folder, summary)
    print(json.dumps(summary))
    return 0
