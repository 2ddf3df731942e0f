"""Pictures of a simulation, for videos and Gymnasium's `render`."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.backends.sim import SimBackend

NAME = "side"


class Camera:
    """Pictures of a simulation from its camera, without shadows; the renderer is made for the first of them.

    Args:
        backend: Which simulation.
        height, width: Pixels.
    """

    def __init__(self, backend: SimBackend, *, height: int = 240, width: int = 320):
        self.backend, self.height, self.width, self._renderer = backend, height, width, None

    def picture(self, sim: int) -> NDArray[np.uint8]:
        """One simulation as it is now, [height, width, 3]."""
        model = self.backend.model
        if self._renderer is None:
            model.vis.quality.offsamples = 0
            self._renderer = mujoco.Renderer(model, self.height, self.width)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        data = self.backend.batch.get_data(sim)
        mujoco.mj_forward(model, data)
        self._renderer.update_scene(data, camera=NAME)
        return self._renderer.render()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
