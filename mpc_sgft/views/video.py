"""An episode as a film."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from envs.backends.sim import SimBackend
from envs.camera import Camera
from envs.env import ControlEnv
from mpc_sgft.command.errors import UserError


class Film:
    """Films episodes of an environment from its camera `side`; whether that can be shows at once.

    Args:
        env: Of size 1.

    Raises:
        UserError: If imageio's extra is not installed, MuJoCo cannot draw here, or no simulator is run.
    """

    def __init__(self, env: ControlEnv) -> None:
        if not isinstance(env.backend, SimBackend):
            raise UserError(f"video=true films the simulator, not {type(env.backend).__name__}: leave it out")
        try:
            import imageio.v2 as imageio
            import imageio_ffmpeg  # noqa: F401, writes MP4
        except ImportError as error:
            raise UserError(f"video=true needs imageio: pip install 'mpc_sgft[video]' ({error})") from error
        import mujoco

        self._open, self.env = imageio.get_writer, env
        self.camera = Camera(env.backend, height=480, width=640)
        env.reset()
        try:
            self.camera.picture(0)
        except (mujoco.FatalError, RuntimeError, AttributeError) as error:
            raise UserError(
                f"MuJoCo cannot draw here ({error}). Without a screen set MUJOCO_GL=egl (or osmesa) before the command"
            ) from error

    def write(self, path: Path, act: Callable[[Tensor, Tensor], Tensor], seed: int) -> Path:
        """One episode as MP4, a picture a control step."""
        task = self.env.task
        self.env.set_seed(seed)
        state, fresh = self.env.reset(), torch.ones(1, dtype=torch.bool)
        with self._open(path, fps=round(1 / task.control_dt), macro_block_size=8) as film:
            for _ in range(task.episode_steps):
                state["action"] = act(state["observation"], fresh)
                state, fresh = self.env.step(state)["next"], torch.zeros(1, dtype=torch.bool)
                film.append_data(self.camera.picture(0))
        self.camera.close()
        return path
