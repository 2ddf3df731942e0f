"""Replay of whole rows: what one environment saw in one round, in its order, for learners that remember."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer


class RowBuffer:
    """Ring buffer of rows of T steps; an episode that ends early is followed by the next one's beginning.

    Args:
        capacity: Steps kept; the oldest rows go first.
        slice_len: Steps of a row [T].
        batch_size: Rows of a batch [B].
        seed: Of the sampling.
        device: Where the steps are kept.

    Raises:
        ValueError: If not even a row fits, or a number is not positive.
    """

    def __init__(
        self, capacity: int, slice_len: int, batch_size: int, seed: int, device: torch.device | str = "cpu"
    ) -> None:
        if not 1 <= slice_len <= capacity or batch_size < 1:
            raise ValueError(
                "RowBuffer wants 1 <= slice_len <= capacity and batch_size >= 1, "
                f"got slice_len={slice_len}, capacity={capacity}, batch_size={batch_size}."
            )
        self.rows, self.slice_len, self.batch_size = capacity // slice_len, slice_len, batch_size
        self._replay = TensorDictReplayBuffer(storage=LazyTensorStorage(self.rows, device=torch.device(device)))
        self._generator = torch.Generator().manual_seed(seed)

    def extend(self, steps: TensorDictBase) -> int:
        """Store rows [N, T]; returns how many steps these are.

        Raises:
            ValueError: If they are longer or shorter than T, or more than fit.
        """
        if steps.shape[1] != self.slice_len or len(steps) > self.rows:
            raise ValueError(f"rows {tuple(steps.shape)} do not fit a buffer of {self.rows} of {self.slice_len} steps.")
        self._replay.extend(steps)
        return steps.numel()

    def sample(self) -> TensorDictBase:
        """Rows drawn uniformly with replacement, [B, T].

        Raises:
            ValueError: If there is none yet.
        """
        if not len(self):
            raise ValueError("The buffer holds no row yet; collect a round before sampling.")
        drawn = torch.randint(len(self), (self.batch_size,), generator=self._generator)
        return self._replay[drawn]

    def __len__(self) -> int:
        return len(self._replay)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on with the same samples; plain tensors and numbers."""
        data = self._replay[:].flatten_keys("/") if len(self) else {}
        held = {str(k): v.clone() for k, v in data.items()}
        return {"data": held, "writer": self._replay.writer.state_dict(), "generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict` of a buffer of the same size."""
        self._replay.empty()
        if state["data"]:
            n = len(next(iter(state["data"].values())))
            data = TensorDict(state["data"], batch_size=[n, self.slice_len]).unflatten_keys("/")
            self._replay.storage.set(torch.arange(n), data)  # type: ignore[arg-type]
        self._replay.writer.load_state_dict(state["writer"])
        self._generator.set_state(state["generator"].cpu())
