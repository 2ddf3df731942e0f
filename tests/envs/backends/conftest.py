"""A robot that speaks the real protocol, and a backend on it, from the numbers in configs/.

Periods are counted on the robot's clock, so that a busy computer makes these tests slow and not wrong; ages of states
and sights, which are on the wall's clock, are generous for the same reason.
"""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import yaml

from envs.backends.arm import Arm
from envs.backends.franka import FrankaBackend
from envs.backends.gripper import Gripper
from envs.backends.limits import Limits
from envs.backends.rig import Rig
from envs.backends.safety import Gate
from envs.backends.stream import SAMPLE_DT
from envs.stand_in.client import StandIn
from envs.tasks.push import Push
from mpc_sgft.command.choices import CONFIG_DIR

SLOW = {"state_age": 1.0, "detection_age": 0.4}


@pytest.fixture(scope="session")
def robot_config() -> dict:
    """configs/backend/franka.yaml."""
    return yaml.safe_load((CONFIG_DIR / "backend" / "franka.yaml").read_text())


@pytest.fixture
def stand_in(robot_push: Push) -> Iterator[StandIn]:
    pytest.importorskip("franky", reason="needs the robot's client")
    pytest.importorskip("franky_sim", reason="needs the robot's client")
    running = StandIn(robot_push)
    yield running
    running.close()


@pytest.fixture
def on_stand_in(robot_push: Push, robot_config: dict) -> Iterator[Callable[..., FrankaBackend]]:
    """on_stand_in(stand_in, width, **limits): a backend that is reset, the gripper holding a tool."""
    made = []

    def make(stand_in: StandIn, width: float | None = None, **changes: float) -> FrankaBackend:
        limits = Limits(**{**robot_config["limits"], **SLOW, **changes})
        gate = Gate(limits, tool_length=robot_push.arm.tool_length, sample_dt=SAMPLE_DT)
        arm = Arm(stand_in.ip, **{**robot_config["arm"], "timeout": 30})
        look = lambda: (stand_in, stand_in.scene.place)  # noqa: E731
        gripper = Gripper(**{**robot_config["gripper"], "width": width})
        rig = Rig(arm, look, gate, gripper=gripper, clock="robot", patience=1.0, dry_run=False)
        backend = FrankaBackend(robot_push, rig, safe_tip=robot_config["safe_tip"], reset_speed=0.4)
        backend.pace.measure = rig.clock.now
        made.append(backend)
        backend.reset(np.arange(1))
        return backend

    yield make
    for backend in made:
        backend.close()


@pytest.fixture
def robot(stand_in: StandIn, on_stand_in: Callable[..., FrankaBackend]) -> FrankaBackend:
    return on_stand_in(stand_in)
