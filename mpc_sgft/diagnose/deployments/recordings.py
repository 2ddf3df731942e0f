"""What `deploy` left behind, read as a robot could have recorded it: nothing here knows the gap.

Of the joint samples, positions, velocities and actuator forces of the machine's own joints are used, and none of the
object's: what is known of it is what was observed. The recorded `ctrl` is not used either; the engine computes from
`action_sent` what the interface asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from envs.task import AbstractTask
from mpc_sgft.command.errors import UserError, from_config
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.simulation.plant import SCALAR
from mpc_sgft.storage.episode_file import Episode, read_episode

MIN_STEPS = 10  # control steps; a shorter episode holds no window


@dataclass(frozen=True)
class Rollout:
    """One real episode of T control steps.

    Attributes:
        name: Of its file.
        action: What was sent, [T, A].
        observation: Before the first step and after each, [T + 1, O].
        time: Of the joint samples since the start [s], [S].
        q, v: Measured joint positions and velocities, [S, nj].
        force: Measured actuator forces, [S, nu].
        success: Whether the goal held at the end.
    """

    name: str
    action: Array
    observation: Array
    time: Array
    q: Array
    v: Array
    force: Array
    success: bool


@dataclass(frozen=True)
class Deployment:
    """A task and what was recorded while it was done.

    Attributes:
        task: The nominal task.
        episodes: In the order they were driven.
        notes: What was left out or lost, in words.
    """

    task: AbstractTask
    episodes: list[Rollout]
    notes: list[str]


def run_config(run: Path) -> DictConfig:
    """The config of a deployment's run folder, the gap included: not for the solver.

    Raises:
        UserError: If the folder is not that of a deployment.
    """
    path = run / "config.yaml"
    if not path.is_file():
        what = "no config.yaml in it" if run.is_dir() else "no such folder"
        raise UserError(f"--run {run}: {what}. Give the run folder of a deployment, e.g. runs/push/latest.")
    try:
        cfg = OmegaConf.load(path)
    except (YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read as YAML ({str(error).splitlines()[0]}).") from error
    wrote = cfg.get("command") if isinstance(cfg, DictConfig) else None
    if not isinstance(cfg, DictConfig) or wrote != "deploy":
        raise UserError(f"--run {run}: {wrote or 'another program'} wrote it. Only deployments hold real episodes.")
    if OmegaConf.select(cfg, "task.env") is None:
        raise UserError(f"{path} names no task: it is not whole. Give the run folder of another deployment.")
    return cfg


def read_deployment(run: Path) -> Deployment:
    """Task and episodes of a run folder; of its config, only the task is read.

    Raises:
        UserError: If the folder is not that of a deployment in simulation, or holds no usable episode.
    """
    cfg = run_config(run)
    if OmegaConf.select(cfg, "backend.name") == "franka":
        raise UserError(
            f"--run {run}: an FR3 or its stand-in drove it. --run knows the table and the controller of --backend sim "
            f"alone. Give what the arm recorded to a model of the arm: --model ARM.xml --data {run}/episodes/*.mcap"
        )
    with from_config("task"):
        task: AbstractTask = instantiate(cfg.task.env, _convert_="all")
    kept = lambda p: len(p.suffixes) == 1  # noqa: E731  # neither .empty.mcap nor .rerecorded.mcap
    paths = sorted(filter(kept, (run / "episodes").glob("*.mcap")))
    if not paths:
        raise UserError(f"--run {run}: no episodes in {run / 'episodes'}. Deploy at least one rollout first.")
    episodes, notes = [], []
    for path in paths:
        try:
            episode = read_episode(path)
        except ValueError as error:
            raise UserError(str(error)) from error
        if episode.lost:
            notes.append(f"{path.name}: {episode.lost}")
        rollout = as_rollout(path.stem, episode, task)
        if len(rollout.action) < MIN_STEPS:
            notes.append(f"{path.name}: only {len(rollout.action)} whole steps, left out")
        else:
            episodes.append(rollout)
    if not episodes:
        raise UserError(f"--run {run}: no episode has {MIN_STEPS} whole steps. {'; '.join(notes)}")
    return Deployment(task, episodes, notes)


def as_rollout(name: str, episode: Episode, task: AbstractTask) -> Rollout:
    """A recording as arrays; steps after a failure of the physics are left out.

    Raises:
        UserError: If it is of another task, or has no joint samples.
    """
    wrong = episode.metadata.get("task", task.name)
    if wrong != task.name:
        raise UserError(f"episode {name}: recorded on task {wrong!r}, the run's config says {task.name!r}.")
    data, joints = episode.transitions, episode.joints
    if not data:
        nothing = np.zeros((0, 0))
        return Rollout(name, nothing, nothing, np.zeros(0), nothing, nothing, nothing, False)
    missing = [k for k in ("time", "qpos", "qvel", "force") if k not in joints]
    if missing:
        raise UserError(f"episode {name}: no joint samples of {', '.join(missing)}; diagnose --run needs them.")
    broken = np.flatnonzero(np.asarray(data.get("invalid", np.zeros(len(data["step"])))))
    steps = int(broken[0]) if len(broken) else len(data["step"])
    columns = {kind: joint_columns(task, kind) for kind in ("qpos", "qvel")}
    whole = joints["time"] <= (data["time"][steps - 1] if steps else 0.0) + 1e-9
    arrays: dict[str, Any] = {
        "q": joints["qpos"][:, columns["qpos"]],
        "v": joints["qvel"][:, columns["qvel"]],
        "force": joints["force"],
    }
    for key, values in arrays.items():
        if not np.isfinite(values[whole]).all():
            raise UserError(f"episode {name}: {key} is not a number in some joint samples.")
    observation = np.concatenate([data["observation"][:1], data["next_observation"]])
    action = np.asarray(data["action_sent"][:steps], float).reshape(steps, -1)
    observation = np.asarray(observation[: steps + 1, : len(task.observation_names)], float)
    for key, values in (("action_sent", action), ("observation", observation)):
        if len(rows := np.flatnonzero(~np.isfinite(values).all(1))):
            raise UserError(f"episode {name}: {key} is not a number in step {rows[0]}. Leave its file out.")
    return Rollout(
        name=name,
        action=action,
        observation=observation,
        time=joints["time"][whole],
        success=bool((episode.outcome or {}).get("success", False)),
        **{key: values[whole] for key, values in arrays.items()},
    )


def joint_columns(task: AbstractTask, kind: str) -> list[int]:
    """Where the machine's hinges and slides stand in qpos or qvel; what hangs together with no motor is an object."""
    return columns_of(task.spec().compile(), kind)


def columns_of(model: mujoco.MjModel, kind: str) -> list[int]:
    """As `joint_columns`, of a task's compiled scene."""
    address = model.jnt_qposadr if kind == "qpos" else model.jnt_dofadr
    kinds, tree = [int(k) for k in SCALAR], model.dof_treeid[model.jnt_dofadr]
    driven = set(tree[model.actuator_trnid[:, 0]].tolist())
    return [int(address[i]) for i in range(model.njnt) if int(model.jnt_type[i]) in kinds and int(tree[i]) in driven]
