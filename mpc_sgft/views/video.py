"""An episode as a film."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from envs.backends.sim import SimBackend
from envs.camera import Camera
from envs.env import ControlEnv
from mpc_sgft.command.errors import UserError


def write_video(path: Path, env: ControlEnv, act: Callable[[Tensor, Tensor], Tensor], seed: int) -> Path:
    """Film one episode of an environment of size 1 from its camera `side`, as MP4 at the control rate.

    Raises:
        UserError: If imageio's extra is not installed, MuJoCo cannot draw here, or no simulator is run.
    """
    if not isinstance(env.backend, SimBackend):
        raise UserError(f"video=true films the simulator, not {type(env.backend).__name__}: leave it out")
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise UserError(f"video=true needs imageio: pip install 'mpc_sgft[video]' ({error})") from error
    import mujoco

    camera = Camera(env.backend, height=480, width=640)
    env.set_seed(seed)
    state, fresh = env.reset(), torch.ones(1, dtype=torch.bool)
    try:
        camera.picture(0)
    except (mujoco.FatalError, RuntimeError, AttributeError) as error:
        raise UserError(
            f"MuJoCo cannot draw here ({error}). Without a screen set MUJOCO_GL=egl (or osmesa) before the command"
        ) from error
    with imageio.get_writer(path, fps=round(1 / env.task.control_dt), macro_block_size=8) as film:
        for _ in range(env.task.episode_steps):
            state["action"] = act(state["observation"], fresh)
            state, fresh = env.step(state)["next"], torch.zeros(1, dtype=torch.bool)
            film.append_data(camera.picture(0))
    camera.close()
    return path
