"""Push something soft to a line: a folded towel, a squashy ball. Agents know them as a puck."""

from abc import abstractmethod

import mujoco
import numpy as np

from envs import fr3
from envs.task import Array, View
from envs.tasks.push import Push

POISSON = 0.2  # of foam and cloth


class PushSoft(Push):
    """`push` with a MuJoCo flex in place of the puck; what is seen of it is the mean of its nodes.

    Action, observation and reward are those of `push`, and `puck_mass` and `puck_friction` are the flex's. On the
    robot it is `push` itself: what lies on the table does not matter to its program.
    """

    arm = None
    height: float  # [m] of the flex's middle above the table, at rest

    def __init__(self, **settings: object):
        super().__init__(**settings)  # pyright: ignore[reportArgumentType]
        model = self.spec().compile()
        nodes = [i for i in range(model.nbody) if model.body(i).name.startswith("puck_")]
        self._nodes = model.body_pos[nodes]  # [n, 3] from the middle
        self.puck_dof = 3 * len(nodes)

    def spec(self) -> mujoco.MjSpec:
        spec = super().spec()
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE  # the one that MuJoCo has for elastic flexes
        return spec

    def _add_puck(self, spec: mujoco.MjSpec) -> None:
        flex = self._add_flex(spec.worldbody.add_body(name="puck", pos=[0.5, 0, self.origin[2] + self.height]))
        flex.selfcollide = 0
        flex.friction, flex.condim, flex.priority = [self.puck_friction, 0.005, 0.0001], 3, 1
        flex.contype, flex.conaffinity = fr3.OBJECT_BIT, fr3.TABLE_BIT
        flex.rgba = [0.85, 0.25, 0.2, 1]

    @abstractmethod
    def _add_flex(self, body: mujoco.MjsBody) -> mujoco.MjsFlex:
        """The flex around the middle of a body, named `puck` as that."""

    def _lying(self, xy: Array, yaw: Array) -> Array:
        """Displacements of the nodes [N, 3 n]."""
        c, s, o, one = np.cos(yaw), np.sin(yaw), 0 * yaw, 1 + 0 * yaw
        turn = np.moveaxis(np.array([[c, -s, o], [s, c, o], [o, o, one]]), -1, 0)
        moved = np.einsum("kij,nj->kni", turn, self._nodes) - self._nodes
        moved[:, :, :2] += (xy + self.origin[:2] - [0.5, 0.0])[:, None]
        return moved.reshape(len(xy), -1)

    def place_of(self, qpos: Array) -> Array:
        moved = qpos[:, 7 : 7 + self.puck_dof].reshape(len(qpos), -1, 3).mean(1)
        return moved + [0.5, 0.0, self.origin[2] + self.height]


class PushTowel(PushSoft):
    """A towel folded to a pad 8 cm wide: it creases where it is pushed, and drags.

    A sheet of 5 by 5 nodes whose edges keep their lengths.
    """

    name = "push_towel"
    height = 0.012  # [m] half the thickness

    def _add_flex(self, body: mujoco.MjsBody) -> mujoco.MjsFlex:
        spacing, thin = 0.015, 0.004  # a sheet thicker than its spacing is refused here, and works
        flex = body.make_flex(
            "puck",
            type="grid",
            dim=2,
            count=[5, 5, 1],
            spacing=[spacing] * 3,
            radius=thin,
            mass=self.puck_mass,
            equality=1,
        )
        flex.radius = self.height
        return flex

    def view(self) -> View:
        return super().view()._replace(object_radius=0.03, object_height=2 * self.height)


class PushBall(PushSoft):
    """A squashy ball, 5 cm wide: it gives way, rolls, and comes to rest late.

    Its skin follows the eight corners of one elastic cell.
    """

    name = "push_ball"
    height = 0.027  # [m]
    STIFFNESS, DAMPING = 2e4, 0.01  # [Pa], [s]

    def _add_flex(self, body: mujoco.MjsBody) -> mujoco.MjsFlex:
        flex = body.make_flex(
            "puck", type="ellipsoid", dim=3, dof="trilinear", count=[5] * 3, cellcount=[1] * 3, spacing=[0.0125] * 3,
            radius=0.002, mass=self.puck_mass,
        )  # fmt: skip
        flex.young, flex.poisson, flex.damping = self.STIFFNESS, POISSON, self.DAMPING
        return flex

    def view(self) -> View:
        return super().view()._replace(object_height=2 * self.height)
