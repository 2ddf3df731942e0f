"""Dry friction whose level depends on the load: MuJoCo's own friction constraint, set anew before each physics step."""

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from envs.effects.base import ROTOR, Effect


class LoadFriction:
    """The effects of a batch that have a `friction`, and the field that carries it.

    Args:
        batch: The simulations.
        model: The task's own model, whose degrees of freedom come first in the batch's.
        whole: The model of the batch, with what effects added.
        effects: All effects; those without a `friction` of their own are left out.

    Raises:
        ValueError: For a joint that the scene lacks.
    """

    def __init__(self, batch: Batch, model: mujoco.MjModel, whole: mujoco.MjModel, effects: list[Effect]):
        self.effects = [e for e in effects if type(e).friction is not Effect.friction]
        if self.effects:
            self.joints = [model.joint(int(i)).name for i in model.dof_jntid]
            self.forces = batch.bind("qfrc_actuator")
            rotors = {whole.joint(i).name: int(whole.jnt_dofadr[i]) for i in range(whole.njnt)}
            self.rotors = [(k, rotors[ROTOR + j]) for k, j in enumerate(self.joints) if ROTOR + j in rotors]
            self.level = batch.expand("dof_frictionloss")[:, : model.nv]
            self.own = self.level.copy()  # without the load
            for effect in self.effects:
                effect.friction(np.zeros_like(self.own), self.joints)

    def take_off(self, sims: NDArray[np.int_]) -> None:
        """Leave simulations with the friction that they have without load."""
        if self.effects:
            self.level[sims] = self.own[sims]

    def take_over(self, sims: NDArray[np.int_]) -> None:
        """What a randomised model says is now the friction without load."""
        if self.effects:
            self.own[sims] = self.level[sims]

    def update(self) -> None:
        """Set the level that goes with the load of the last step; what drives a joint's rotor loads the joint."""
        if not self.effects:
            return
        load = self.forces[:, : self.level.shape[1]].copy()
        for joint, rotor in self.rotors:
            load[:, joint] += self.forces[:, rotor]
        levels = [effect.friction(load, self.joints) for effect in self.effects]
        if levels:
            self.level[:] = self.own + sum(level for level in levels if level is not None)
