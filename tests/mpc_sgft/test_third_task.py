"""A task that shares nothing with the shipped ones goes through everything generic: what is special, it says itself."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader
from torchrl.envs.utils import check_env_specs

import envs
import mpc_sgft
from envs.backends.franka import FrankaBackend
from envs.backends.sim import SimBackend
from envs.effects import load
from envs.env import ControlEnv
from envs.task import AbstractTask, Start, ValuePlane
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs.real_rollout import drive
from mpc_sgft.views.deploy_view import DeployViewer
from planners.mppi import MPPI

LIFT = """<mujoco><worldbody><body name="cabin"><joint name="shaft" type="slide" axis="0 0 1" damping="20"/>
<geom type="box" size=".3 .3 .4" mass="5"/></body></worldbody>
<actuator><position name="winch" joint="shaft" kp="400" nsample="100"/></actuator></mujoco>"""
SIZES = dict(latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)


class Lift(AbstractTask):
    """Raise a cabin to the third floor, 2 m up. Observation: height [m], speed [m/s], commanded height [m]."""

    name = "lift"
    observation_names = ("height", "speed", "asked")
    action_dim, episode_steps, control_dt, sim_dt = 1, 8, 0.1, 0.01

    def spec(self):
        spec = mujoco.MjSpec.from_string(LIFT)
        spec.option.timestep = self.sim_dt
        return spec

    def start(self, rng):
        return Start(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))

    def move(self, target, action):
        return np.clip(target + 0.4 * action, 0, 3)

    def ctrl(self, target, previous_ctrl):
        return target

    def observe(self, qpos, qvel):
        return np.concatenate([qpos, qvel, np.zeros_like(qpos)], 1)

    def reward(self, observation, action):
        return -np.abs(observation[:, 0] - 2)

    def success(self, observation):
        return np.abs(observation[:, 0] - 2) < 0.2

    def scripted(self, observation):
        return np.sign(2 - observation[:, :1])

    def points(self, observation):
        height = np.asarray(observation)[..., :1]
        return {"tool": np.concatenate([np.zeros_like(height), np.zeros_like(height), height], -1)}

    def value_plane(self, points):
        height, speed = np.meshgrid(np.linspace(0, 3, points), np.linspace(-1, 1, points), indexing="ij")
        rows = np.stack([height.ravel(), speed.ravel(), height.ravel()], 1)
        return ValuePlane(rows, (points, points), (0, 3, -1, 1), (("height", "m"), ("speed", "m/s")), {"floor": (2, 0)})


@pytest.fixture
def env():
    return ControlEnv(SimBackend(Lift(), 1, effects=load({"actuator_gain": {"gain": 0.8}})), history=2)


def test_it_is_an_environment_and_can_be_solved(env):
    check_env_specs(env)
    state = env.reset()
    for _ in range(Lift.episode_steps):
        state["action"] = torch.from_numpy(Lift().scripted(state["observation"][:, :3].numpy())).float()
        state = env.step(state)["next"]
    assert state["observation"][0, 0] > 0.5


def test_a_rollout_is_driven_recorded_and_drawn(env, tmp_path):
    torch.manual_seed(0)
    sizes = {"obs_dim": env.obs_dim, "action_dim": 1, "decode_dim": env.raw_dim, "memory_dim": 2}
    model = WorldModel(**SIZES, **sizes)
    search = dict(num_candidates=16, num_prior=4, num_elites=8, iterations=2, min_std=0.1, max_std=1.0, temperature=1.0)
    planner = MPPI(action_dim=1, horizon=3, discount=0.9, chunk_rows=64, **search)
    path = tmp_path / "1.mcap"
    rollout = drive(env, model, planner, path, number=1, seed=0, noise=0.0, candidate_steps=(0,))
    viewer = DeployViewer(tmp_path / "run.rrd", env, resume=False)
    viewer.value_map("before", model)
    viewer.episode(rollout, model, torch.zeros(len(rollout.steps), 3), 1, 0.9)
    viewer.value_map("after", model)
    viewer.close()
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "run.rrd").stream()}
    assert "/value_map/before/axes" in entities
    assert any("candidate" in e for e in entities) and not any("object" in e for e in entities)


def test_the_robot_backend_asks_and_refuses():
    with pytest.raises(ValueError, match="task lift has no FR3"):
        FrankaBackend(Lift(), rig=None, safe_tip=(0, 0, 0), reset_speed=0.1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="lift has no object"):
        Lift().place_of(np.zeros((1, 1)))


def test_generic_code_names_no_task():
    generic = [
        p for room in ("backends", "perception", "stand_in") for p in (Path(envs.__path__[0]) / room).glob("*.py")
    ]
    generic += [Path(envs.__path__[0]) / f"{name}.py" for name in ("env", "task", "gym", "randomize", "camera")]
    generic += Path(mpc_sgft.__path__[0]).rglob("*.py")
    wrong = []
    for path in generic:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if re.search(r"[Pp]uck|goal_x|goal line|envs\.tasks|ORIGIN|task\.(origin|goal|name ==)", line):
                wrong.append(f"{path.name}:{number}: {line.strip()}")
    assert len(generic) > 100 and not wrong
