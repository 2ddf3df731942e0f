"""A MuJoCo model as rerun entities: its shapes once, its bodies' poses and what is soft as columns."""

import copy

import mujoco
import numpy as np
import rerun as rr
from rerun_loader_mjcf import MJCFLogger

PLANE_HALF_SIZE = 1.5  # [m] where a plane is drawn without end
PLANE_THICKNESS = 0.004  # [m]


class RobotView:
    """Draws one model under one entity path.

    Args:
        recording: Where to.
        model: What; it is not changed.
        path: Entity path prefix, such as "world/robot".
        opacity: None for solid, otherwise 0…1.
    """

    def __init__(
        self, recording: rr.RecordingStream, model: mujoco.MjModel, path: str, opacity: float | None = None
    ) -> None:
        self._recording = recording
        self._model = model
        self._data = mujoco.MjData(model)
        self._path, self._opacity = path, opacity
        self._logger = MJCFLogger(drawable(model), path, opacity=opacity)

    def log_shapes(self) -> None:
        """Log the geometry at the recording's current time."""
        self._logger.log_model(self._recording)
        for flex in range(self._model.nflex):
            color = self._model.flex_rgba[flex].copy()
            color[3] = color[3] if self._opacity is None else self._opacity
            mesh = rr.Mesh3D.from_fields(triangle_indices=triangles(self._model, flex), albedo_factor=color)
            self._recording.log(self._flex_path(flex), mesh, static=True)

    def log_poses(self, indexes: list[rr.TimeColumn], qpos: np.ndarray) -> None:
        """Log where every body is, qpos [R, nq], one row of the indexes each.

        Raises:
            ValueError: If qpos has another width than the model's nq.
        """
        if qpos.ndim != 2 or qpos.shape[1] != self._model.nq:
            raise ValueError(f"qpos must be [rows, {self._model.nq}] for this model, got {qpos.shape}.")
        position = np.empty((len(qpos), self._model.nbody, 3))
        quaternion = np.empty((len(qpos), self._model.nbody, 4))
        vertices = np.empty((len(qpos), self._model.nflexvert, 3))
        for row, q in enumerate(qpos):
            self._data.qpos[:] = q
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_flex(self._model, self._data)
            position[row], quaternion[row] = self._data.xpos, self._data.xquat
            vertices[row] = self._data.flexvert_xpos
        quaternion = np.roll(quaternion, -1, axis=-1)  # MuJoCo has w first, rerun last
        for body in range(1, self._model.nbody):
            name = self._model.body(body).name or f"body_{body}"
            columns = rr.Transform3D.columns(translation=position[:, body], quaternion=quaternion[:, body])
            self._recording.send_columns(self._logger.paths.body_path(name), indexes, columns)
        for flex in range(self._model.nflex):
            start, count = self._model.flex_vertadr[flex], self._model.flex_vertnum[flex]
            moved = rr.Mesh3D.columns(vertex_positions=vertices[:, start : start + count].reshape(-1, 3))
            self._recording.send_columns(self._flex_path(flex), indexes, moved.partition([count] * len(qpos)))

    def _flex_path(self, flex: int) -> str:
        return f"{self._path}/flexes/{mujoco.mj_id2name(self._model, mujoco.mjtObj.mjOBJ_FLEX, flex) or flex}"


def triangles(model: mujoco.MjModel, flex: int) -> np.ndarray:
    """Vertices of each triangle of a sheet, or of a solid's skin, [F, 3]; of a flex of lines none."""
    if model.flex_dim[flex] == 1:
        return np.empty((0, 3), np.int32)
    all_, start, count = model.flex_elem, model.flex_elemdataadr[flex], model.flex_elemnum[flex]
    if model.flex_dim[flex] == 3:
        all_, start, count = model.flex_shell, model.flex_shelldataadr[flex], model.flex_shellnum[flex]
    return all_[start : start + 3 * count].reshape(-1, 3)


def drawable(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy for drawing only, shaped for what the loader draws.

    Geoms of the groups that MuJoCo shows (0 to 2) no longer collide, because next to one that does not collide the
    loader leaves out those that do. Planes become thin boxes, because it leaves out planes without a texture.
    """
    model = copy.copy(model)
    shown = model.geom_group < 3
    model.geom_contype[shown], model.geom_conaffinity[shown] = 0, 0
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        half = np.where(model.geom_size[geom, :2] > 0, model.geom_size[geom, :2], PLANE_HALF_SIZE)
        normal = np.empty(9)
        mujoco.mju_quat2Mat(normal, model.geom_quat[geom])
        model.geom_type[geom] = mujoco.mjtGeom.mjGEOM_BOX
        model.geom_size[geom] = [*half, PLANE_THICKNESS / 2]
        model.geom_pos[geom] -= normal.reshape(3, 3)[:, 2] * PLANE_THICKNESS / 2
    return model
