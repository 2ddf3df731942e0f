"""Domain randomisation: each episode draws its own model, field by field."""

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from envs.effects.base import ADDED

OPERATIONS = {"add": np.add, "scale": np.multiply, "set": lambda nominal, drawn: np.full_like(nominal, drawn)}


@dataclass(frozen=True)
class Draw:
    """One random number per episode, written into fields of the model.

    Attributes:
        fields: MjModel fields, with an optional last index: `geom_friction[0]`.
        at: Names of the rows to write (bodies, geoms, joints, actuators, tendons, by the field's prefix); all if empty.
        operation: `add` to, `scale`, or `set` the nominal value.
        low, high: Range of the draw, in the field's unit.
        distribution: `uniform` or `loguniform`.
    """

    fields: tuple[str, ...]
    low: float
    high: float
    at: tuple[str, ...] = ()
    operation: str = "scale"
    distribution: str = "uniform"

    def __post_init__(self) -> None:
        if self.operation not in OPERATIONS:
            raise ValueError(f"operation={self.operation!r}; allowed: {', '.join(OPERATIONS)}")
        if self.distribution not in ("uniform", "loguniform"):
            raise ValueError(f"distribution={self.distribution!r}; allowed: uniform, loguniform")
        if self.low > self.high or (self.distribution == "loguniform" and self.low <= 0):
            raise ValueError(f"range {self.low} to {self.high} is empty or not positive ({self.distribution})")

    def value(self, place: float) -> float:
        """The number at a place in the range, 0 at `low` and 1 at `high`."""
        if self.distribution == "loguniform":
            return float(np.exp(np.log(self.low) + (np.log(self.high) - np.log(self.low)) * place))
        return self.low + (self.high - self.low) * place

    def write(self, field: NDArray, rows: list[int], column: int | None, value: float) -> None:
        """Change the rows of a model's field, or one column of them, by the number drawn."""
        where = (rows, column) if column is not None else rows
        field[where] = OPERATIONS[self.operation](field[where], value)


def load(draws: Mapping[str, Mapping[str, Any]]) -> list[Draw]:
    """Build draws from configs/randomize/*.yaml, {name: {fields, at, operation, low, high, distribution}}.

    Raises:
        ValueError: For an unknown or missing key, or a value that is not allowed.
    """
    if not isinstance(draws, Mapping):
        raise ValueError(f"draws={draws} must map names to draws; {{}} for none")
    built = []
    for name, entries in draws.items():
        try:
            known: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in (entries or {}).items()}
            for key in {"fields", "at"} & set(known):
                known[key] = (known[key],) if isinstance(known[key], str) else known[key]
            built.append(Draw(**known))
        except TypeError as error:
            raise ValueError(
                f"randomize draw {name!r}: {error}. It has: {', '.join(f.name for f in fields(Draw))}."
            ) from error
    return built


def changed(model: mujoco.MjModel, draws: Sequence[Draw], values: Sequence[float]) -> mujoco.MjModel:
    """A copy of a model into which each draw has written its value.

    Raises:
        ValueError: For a field or a name that the model lacks.
    """
    made = copy.copy(model)
    for draw, value in zip(draws, values, strict=True):
        for field in draw.fields:
            name, rows, column = _locate(made, field, draw.at)
            draw.write(getattr(made, name), rows, column, value)
    mujoco.mj_setConst(made, mujoco.MjData(made))
    return made


class Randomizer:
    """Writes the draws into the per-simulation fields of a batch.

    Attributes:
        places: Where in its range each simulation's last draws lie, 0 to 1, [N, D].
        shapes: Beta distributions to draw these places from, (a, b) each draw, [D, 2]; None: uniform.
        given: Places to take instead of drawing, [N, D]; None: they are drawn.

    Raises:
        ValueError: For a field or a name that the model lacks, or a delay that its command history cannot hold.
    """

    def __init__(self, batch: Batch, model: mujoco.MjModel, draws: list[Draw], sims: int):
        self.batch, self.draws = batch, draws
        self.places = np.full((sims, len(draws)), np.nan)
        self.shapes: NDArray | None = None
        self.given: NDArray | None = None
        self.targets = [[_locate(model, field, d.at) for field in d.fields] for d in draws]
        names = {name for targets in self.targets for name, _, _ in targets}
        self.arrays = {name: batch.expand(name) for name in names}
        self.nominal = {name: np.array(getattr(model, name)) for name in names}
        inputs = mujoco.MjModel._setconst_inputs
        self.needs_constants = any(name in inputs for name in names)
        self._check_delays(model)

    def draw(self, sims: list[int], rngs: list[np.random.Generator]) -> None:
        """Give each simulation in `sims` a model of its own, drawn with its own generator."""
        for sim, rng in zip(sims, rngs, strict=True):
            self.places[sim] = self._places(sim, rng)
            values = [d.value(float(x)) for d, x in zip(self.draws, self.places[sim], strict=True)]
            self._write({name: array[sim] for name, array in self.arrays.items()}, values)
        if self.needs_constants and sims:
            self.batch.set_const(np.array(sims, np.int32))

    def _places(self, sim: int, rng: np.random.Generator) -> NDArray:
        if self.given is not None:
            return self.given[sim]
        return rng.random(len(self.draws)) if self.shapes is None else rng.beta(*self.shapes.T)

    def _write(self, model: dict[str, NDArray], values: list[float]) -> None:
        """Write the nominal model with `values`, one each draw, into one simulation's fields."""
        for name, field in model.items():
            field[...] = self.nominal[name]
        for draw, targets, value in zip(self.draws, self.targets, values, strict=True):
            for name, rows, column in targets:
                draw.write(model[name], rows, column, value)

    def _check_delays(self, model: mujoco.MjModel) -> None:
        """MuJoCo silently clips a delay that is longer than the command history."""
        if "actuator_delay" not in self.nominal:
            return
        held = model.actuator_history[:, 0] * model.opt.timestep
        for values in ([d.low for d in self.draws], [d.high for d in self.draws]):
            drawn = {name: array.copy() for name, array in self.nominal.items()}
            self._write(drawn, values)
            delay = drawn["actuator_delay"]
            if (delay < 0).any() or (delay > held).any():
                raise ValueError(
                    f"randomised actuator_delay of {delay.min():.3g} to {delay.max():.3g} s: the model's history holds "
                    f"0 to {held.min():.3g} s; change the range or raise the actuators' nsample"
                )


def _locate(model: mujoco.MjModel, field: str, at: tuple[str, ...]) -> tuple[str, list[int], int | None]:
    """(name, rows, column) of the field 'geom_friction[0]' at what is named; without names, of all but added ones."""
    match = re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", field)
    name = match[1] if match else field
    if not match or not hasattr(model, name):
        raise ValueError(f"MjModel has no field {field!r} to randomise")
    kinds = {"body": "body", "geom": "geom", "dof": "joint", "jnt": "joint"}
    kinds |= {"actuator": "actuator", "tendon": "tendon"}
    prefix = name.split("_")[0]
    if prefix not in kinds:
        raise ValueError(f"field {field!r}: only fields of {', '.join(kinds)} can be randomised")
    array, column = getattr(model, name), int(match[2]) if match[2] else None
    if column is not None and (array.ndim < 2 or column >= array.shape[1]):
        raise ValueError(f"field {field!r}: {name} has the shape {array.shape}")
    access = getattr(model, kinds[prefix])
    try:
        ids = [access(n).id for n in at]
    except KeyError as error:
        raise ValueError(f"randomise {field}: {error.args[0]}") from error
    if prefix == "dof":
        ids = [int(dof) for i in ids for dof in np.flatnonzero(model.dof_jntid == i)]
    return name, ids if at else _own(model, prefix, len(array)), column


def _own(model: mujoco.MjModel, prefix: str, count: int) -> list[int]:
    """Rows without actuators and tendons that effects put into the scene; a rotor has what its joint gave it."""
    if prefix == "actuator":
        return np.flatnonzero(model.actuator_ctrlspec != int(mujoco.mjtCtrlInput.mjINPUT_NONE)).tolist()
    if prefix == "tendon":
        return [i for i in range(count) if not model.tendon(i).name.startswith(ADDED)]
    return list(range(count))
