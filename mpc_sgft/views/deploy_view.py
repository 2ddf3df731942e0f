"""A rollout as the rerun viewer shows it: observations become points, plans become imagined paths."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from envs.env import ControlEnv
from envs.task import ValuePlane
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.storage.rollout import Rollout
from mpc_sgft.views.blueprint import Layout
from mpc_sgft.views.episode_view import Candidates, EpisodeView
from mpc_sgft.views.viewer import RunViewer
from planners.base import imagine

GRID = 41  # points of the value map along each axis


def layout(env: ControlEnv) -> Layout:
    """How the viewer shows a task, as the task says."""
    plane = env.task.value_plane(2)
    if plane is None:
        return Layout(**env.task.view()._asdict(), value_maps=(), metrics=("success",))
    label = f"V({', '.join(name for name, _ in plane.axes)})"
    return Layout(**env.task.view()._asdict(), value_label=label, metrics=("success",))


class DeployViewer:
    """Writes run.rrd of a deployment. The ghost is decoded from the latent by the model's decoder head.

    Args:
        path: The .rrd.
        env: The task, for its model and its named points.
        megabytes: That the file stays below, as in `RunViewer`; 0: no bound.
        resume: Go on with a file that is there.
    """

    def __init__(self, path: Path, env: ControlEnv, *, megabytes: float = 300.0, resume: bool):
        self.env, self.task = env, env.task
        model = getattr(env.backend, "model", None)
        dt, limit = env.task.control_dt, int(megabytes * 1e6) or None
        self.viewer = RunViewer(path, model, control_dt=dt, layout=layout(env), limit=limit, resume=resume)
        self.limits: tuple[float, float] | None = None

    def episode(self, rollout: Rollout, model: WorldModel, error: Tensor, number: int, discount: float) -> None:
        """Add one rollout; one read back from a file has no imagination to show, and may be there already."""
        steps, names = rollout.steps, self.task.points(np.zeros((1, self.env.raw_dim)))
        observation = torch.cat([steps["observation"], steps["next", "observation"][-1:]])
        real = self._points(observation[:, : self.env.raw_dim])
        title = f"rollout {number}" + (f" (aborted: {rollout.aborted})" if rollout.aborted else "")
        if rollout.plans is None and title in self.viewer.earlier:
            return
        reward = steps["next", "reward"][:, 0].numpy()
        view = EpisodeView(
            title=title,
            ee=real.get("tool", np.zeros((len(observation), 3))),
            object=real.get("object"),
            qpos=rollout.qpos,
            reward=reward,
            model_error=error.numpy(),
            success=rollout.success,
        )
        if rollout.plans is None or rollout.values is None:
            self.viewer.episode(view)
            return
        view = view._replace(predicted_return=rollout.values.numpy(), plan_ms=rollout.plan_ms)
        view = view._replace(real_return=_realised(model, steps["next"], reward, rollout.plans.shape[1], discount))
        if names:
            imagined = self._imagined(model, steps["observation"], rollout.plans)
            paths = []
            for t, plans, values in rollout.candidates:
                many = self._imagined(model, steps["observation"][t].expand(len(plans), -1), plans)
                paths.append(Candidates(t, many["tool"], values.numpy()))
            view = view._replace(imagined_ee=imagined["tool"], imagined_object=imagined.get("object"), candidates=paths)
        self.viewer.episode(view)

    def value_map(self, name: str, model: WorldModel) -> None:
        """V over the plane that the task names, in a state at rest with no commands behind it."""
        plane = self.task.value_plane(GRID)
        if plane is None:
            return
        grid = values_on(plane, model, self.env.history)
        self.limits = self.limits or (float(grid.min()), float(grid.max()))
        self.viewer.value_map(name, grid, plane.extent, marks=plane.marks, limits=self.limits, axes=plane.axes)

    def success(self, share: float) -> None:
        """Add the success of an evaluation."""
        self.viewer.metrics(self.viewer.env_step, {"success": share})

    def correct(self, success: bool | None) -> None:
        """What the last rollout counts as after all; None: it is driven again."""
        self.viewer.correct(success)

    def close(self) -> None:
        self.viewer.close()

    def _points(self, raw: Tensor) -> dict[str, np.ndarray]:
        return self.task.points(raw.double().numpy())

    def _imagined(self, model: WorldModel, observation: Tensor, plans: Tensor) -> dict[str, np.ndarray]:
        """Points imagined along plans [M, H, A] from observations [M, O], each [M, H+1, 3]."""
        device = next(model.parameters()).device
        with torch.inference_mode():
            latents = imagine(model, model.encode(observation.to(device)), plans.to(device))
            return self._points(model.decode(latents).cpu())


def values_on(plane: ValuePlane, model: WorldModel, history: int) -> np.ndarray:
    """V over a plane, at rest with no commands behind it, as large as the plane's grid."""
    return values_at_rest(plane.observation, model, history).reshape(plane.shape)


@torch.inference_mode()
def values_at_rest(observation: np.ndarray, model: WorldModel, history: int) -> np.ndarray:
    """V [N] of observations [N, O] that have long been so, with no commands behind them."""
    still = np.tile(observation, (1, history + 1))
    past = np.zeros((len(still), model.obs_dim - still.shape[1]))
    whole = torch.from_numpy(np.concatenate([still, past], 1)).float()
    return model.terminal_value(model.encode(whole.to(next(model.parameters()).device))).cpu().numpy()


def _realised(model: WorldModel, following, reward: np.ndarray, horizon: int, discount: float) -> np.ndarray:
    """What came of each step over the plan's horizon: rewards, then V of the latent reached, [T]."""
    device = next(model.parameters()).device
    with torch.inference_mode():
        value = model.terminal_value(model.encode(following["observation"].to(device))).cpu().numpy()
    value = np.where(following["terminated"][:, 0], 0.0, value)  # nothing comes after
    out = np.empty_like(reward)
    for t in range(len(reward)):
        end = min(t + horizon, len(reward))
        out[t] = (reward[t:end] * discount ** np.arange(end - t)).sum() + discount ** (end - t) * value[end - 1]
    return out
