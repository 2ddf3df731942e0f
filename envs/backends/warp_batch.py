"""MuJoCo Warp behind the interface of `mujoco.batch.Batch`: the same simulations, stepped on a GPU.

Source: MuJoCo Warp (mujoco_warp 4.0), Google DeepMind and NVIDIA. It computes in float32.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

SMALL = ("time", "qpos", "qvel", "act", "ctrl", "qfrc_applied")  # of the state: travels both ways with every rollout
LARGE = ("history", "qacc_warmstart")  # stays on the device; sent once after a reset
LIMIT = 1e10  # MuJoCo's own bound of a state that is not bad (mjMAXVAL)
FULL = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)


class WarpBatch(Batch):
    """`Batch` whose rollouts run on a CUDA device, or on the CPU (slower than `Batch` there: for tests).

    State and per-simulation model fields live in host memory as in `Batch`; a rollout sends them, takes all its physics
    steps on the device (on CUDA as one graph), and brings state and records back. `history` and `qacc_warmstart` are
    read only after a `reset` of the simulation and are not brought back.

    Args:
        model: Of every simulation.
        nsim: How many.
        device: A Warp device, such as "cuda:0" or "cpu"; None takes CUDA where there is one.

    Raises:
        ValueError: For a model that MuJoCo Warp cannot simulate.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, device: str | None = None) -> None:
        super().__init__(model, nsim, 1)
        wp.config.log_level = wp.LOG_WARNING
        self.device = wp.get_device(device or ("cuda:0" if wp.is_cuda_available() else "cpu"))
        self._fields: dict[str, torch.Tensor] = {}  # model fields on the device that differ between simulations
        self._outputs: dict[str, NDArray] = {}
        self._fresh = np.ones(nsim, bool)  # reset since the last rollout
        self._graphs: dict[tuple, tuple] = {}
        self._model: mjw.Model | None = None
        try:
            with wp.ScopedDevice(self.device):
                self._on_device = mjw.make_data(model, nworld=nsim)
                self._place_model([])
        except NotImplementedError as error:
            raise ValueError(f"MuJoCo Warp cannot simulate this scene: {error} Use physics=mujoco.") from error

    def bind(self, name: str) -> NDArray:
        if name in (*SMALL, *LARGE):
            return super().bind(name)
        if name not in self._outputs:
            found = self._view(self._on_device, name)
            self._outputs[name] = np.zeros(found.shape)
        return self._outputs[name]

    def expand(self, name: str) -> NDArray:
        if not _is_batched(name):
            raise ValueError(f"MuJoCo Warp has one {name} for all simulations: use physics=mujoco to vary it.")
        return super().expand(name)

    def reset(self, ids=None, keyframe=-1, stage=mujoco.mjtStage.mjSTAGE_ACC) -> None:
        super().reset(ids, keyframe, stage)
        self._fresh[np.arange(self.nsim) if ids is None else np.asarray(ids)] = True

    def rollout(
        self,
        nstep: int,
        control: NDArray | None = None,
        control_spec: int = int(mujoco.mjtState.mjSTATE_CTRL),
        record: Sequence[str] = ("qpos",),
        ids=None,
        out=None,
    ) -> dict[str, NDArray]:
        """As `Batch.rollout`, of all simulations, with controls alone as what is given at each step."""
        if ids is not None or out is not None or control is None or control_spec != mujoco.mjtState.mjSTATE_CTRL:
            raise ValueError("WarpBatch rolls out all simulations, under given controls")
        with wp.ScopedDevice(self.device):
            self._send_model()
            self._send_state()
            steps, controls, records = self._prepared(nstep, tuple(record))
            controls.copy_(torch.from_numpy(np.ascontiguousarray(control.swapaxes(0, 1), np.float32)))
            steps()
            self._bring_back()
            return {n: np.swapaxes(x.cpu().numpy().astype(np.float64), 0, 1) for n, x in records.items()}

    def _place_model(self, names: list[str]) -> None:
        self._model = mjw.put_model(self.model, batch_sizes=dict.fromkeys(names, self.nsim))
        self._model.opt.warn_overflow = False  # it is counted in `warning` instead
        self._fields = {name: self._view(self._model, name) for name in names}
        self._graphs.clear()

    def _send_model(self) -> None:
        """Per-simulation model fields; those that MuJoCo Warp has no use for are left out."""
        differing = [n for n in MODEL_FIELDS if _is_batched(n) and self.expanded(n) is not None]
        if set(differing) != set(self._fields):
            self._place_model(differing)
        for name, there in self._fields.items():
            there.copy_(torch.from_numpy(np.array(self.expanded(name))).reshape(there.shape))

    def _send_state(self) -> None:
        for name in SMALL:
            there = self._view(self._on_device, name)
            there.copy_(torch.from_numpy(np.ascontiguousarray(super().bind(name))))
        fresh = np.flatnonzero(self._fresh)
        if len(fresh):
            rows = torch.from_numpy(fresh)
            for name in LARGE:
                there = self._view(self._on_device, name)
                there[rows.to(there.device)] = torch.from_numpy(super().bind(name)[fresh]).to(there)
        self._fresh[:] = False

    def _bring_back(self) -> None:
        """The state, the bound outputs, and a warning where a simulation has gone bad or lacked room for contacts."""
        for name in SMALL:
            super().bind(name)[...] = self._view(self._on_device, name).cpu().numpy()
        for name, here in self._outputs.items():
            here[...] = self._view(self._on_device, name).cpu().numpy()
        for name, kind in (("qpos", mujoco.mjtWarning.mjWARN_BADQPOS), ("qvel", mujoco.mjtWarning.mjWARN_BADQVEL)):
            bad = ~(np.abs(super().bind(name)) < LIMIT).all(1)
            self.warning[bad, int(kind), 1] += 1
        overflow = wp.to_torch(self._on_device.overflow)
        self.warning[overflow.cpu().numpy() != 0, int(FULL[0]), 1] += 1
        overflow.zero_()

    def _prepared(self, nstep: int, record: tuple[str, ...]) -> tuple:
        """What takes `nstep` steps, and the device arrays of its controls and records."""
        key = nstep, record
        if key not in self._graphs:
            data, model = self._on_device, self._model
            controls: Any = wp.zeros((nstep, *data.ctrl.shape), dtype=float)
            records: dict[str, Any] = {n: wp.zeros((nstep, *getattr(data, n).shape), dtype=float) for n in record}

            def steps() -> None:
                for k in range(nstep):
                    wp.copy(data.ctrl, controls[k])
                    mjw.step(model, data)
                    for name, kept in records.items():
                        wp.copy(kept[k], getattr(data, name))

            run = _captured(steps, mjw.step, model, data) if self.device.is_cuda else steps
            self._graphs[key] = run, wp.to_torch(controls), {n: wp.to_torch(x) for n, x in records.items()}
        return self._graphs[key]

    @staticmethod
    def _view(holder: object, name: str) -> torch.Tensor:
        return wp.to_torch(getattr(holder, name))


def _is_batched(name: str) -> bool:
    """Whether MuJoCo Warp can give this model field a value a simulation."""
    spec = mjw.Model.__dataclass_fields__.get(name)
    shape = getattr(spec.type, "shape", None) if spec else None
    return bool(shape) and shape[0] == "*"


def _captured(steps, once, model, data):
    """`steps` as one CUDA graph. What it launches is compiled first, by one step from a state that is put back."""
    kept = {name: wp.clone(getattr(data, name)) for name in (*SMALL, *LARGE)}
    once(model, data)
    for name, values in kept.items():
        wp.copy(getattr(data, name), values)
    with wp.ScopedCapture() as capture:
        steps()
    graph: Any = capture.graph
    return lambda: wp.capture_launch(graph)
