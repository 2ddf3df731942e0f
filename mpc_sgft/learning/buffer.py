"""Replay of slices of consecutive steps, on TorchRL's storage.

TorchRL's own SliceSampler crosses episodes on flat storages and is uniform over trajectories, not over frames; this
sampler keeps, for every stored row, the rows before and after it in the same episode, and draws uniformly over the rows
from which T consecutive steps follow.
"""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler

NONE = -1  # no such row
ROWS = ("previous", "following", "episode", "valid")


class SliceSampler(Sampler):
    """Uniform over all starts of `slice_len` consecutive steps of one episode.

    Rows are linked by (episode, step), not by where they lie, so an episode may arrive in pieces and between other
    environments' rows, and a ring buffer may wrap through it. An episode with fewer than `slice_len` stored steps
    contributes nothing.

    Args:
        capacity: Rows of the storage.
        slice_len: Steps of a slice [T].
        seed: Of the sampler's own generator.
        device: Where the links between rows live, and where samples are drawn.
    """

    def __init__(self, capacity: int, slice_len: int, seed: int, device: torch.device) -> None:
        self.slice_len = slice_len
        self.generator = torch.Generator(device).manual_seed(seed)
        self.previous, self.following, self.episode = (torch.full((capacity,), NONE, device=device) for _ in range(3))
        self.valid = torch.zeros(capacity, dtype=torch.bool, device=device)  # T steps follow, this one included
        self.tails: dict[int, tuple[int, int]] = {}  # episode -> (last row, its step)
        self._starts: Tensor | None = None

    def link(self, index: Tensor, episode: Tensor, step: Tensor) -> None:
        """Take in rows just written at `index` [n] in this order; what they overwrote is forgotten."""
        self._forget(index)
        if not len(index):
            return
        goes_on = (episode[1:] == episode[:-1]) & (step[1:] == step[:-1] + 1)  # [n - 1]
        self.episode[index] = episode
        self._join(index[:-1][goes_on], index[1:][goes_on])
        cut = (~goes_on).nonzero().flatten()
        first = torch.cat([cut.new_zeros(1), cut + 1])  # of each run of consecutive steps
        last = torch.cat([cut, cut.new_full((1,), len(index) - 1)])
        runs = torch.stack([episode[first], step[first], index[first], step[last], index[last]], 1).tolist()
        joins = []
        for e, s, row, last_step, last_row in runs:
            tail = self.tails.get(e)
            if tail is not None and tail[1] == s - 1:
                joins.append((tail[0], row))
            self.tails[e] = (last_row, last_step)
        if joins:
            self._join(*torch.tensor(joins, device=index.device).unbind(1))
        start = index
        for _ in range(self.slice_len - 1):
            start = start[start != NONE]
            start = self.previous[start]
        self.valid[start[start != NONE]] = True
        self._starts = None

    def _join(self, before: Tensor, after: Tensor) -> None:
        self.following[before], self.previous[after] = after, before

    def _forget(self, index: Tensor) -> None:
        start = index
        for _ in range(self.slice_len):
            self.valid[start] = False
            start = self.previous[start]
            start = start[start != NONE]
        before, after = self.previous[index], self.following[index]
        ends = index[after == NONE]  # also rows never written, whose episode is NONE
        for e, row in zip(self.episode[ends].tolist(), ends.tolist(), strict=True):
            if self.tails.get(e, (NONE, NONE))[0] == row:
                del self.tails[e]
        self.following[before[before != NONE]] = NONE
        self.previous[after[after != NONE]] = NONE
        self.previous[index] = self.following[index] = self.episode[index] = NONE

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict]:
        """Rows of `batch_size` slices, [B, T]."""
        if self._starts is None:
            self._starts = self.valid.nonzero().flatten()
        if not len(self._starts):
            raise ValueError(
                f"The buffer holds {len(storage)} steps but no {self.slice_len} consecutive steps of one episode; "
                "collect more before sampling."
            )
        drawn = torch.randint(len(self._starts), (batch_size,), generator=self.generator, device=self.generator.device)
        row = self._starts[drawn]
        rows = [row]
        for _ in range(self.slice_len - 1):
            rows.append(self.following[rows[-1]])
        return torch.stack(rows, 1), {}

    def state_dict(self) -> dict[str, Any]:
        tails = torch.tensor([[e, *tail] for e, tail in self.tails.items()], dtype=torch.long).reshape(-1, 3)
        rows = {name: getattr(self, name).clone() for name in ROWS}
        return {**rows, "tails": tails, "generator": self.generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        for name in ROWS:
            rows, saved = getattr(self, name), state_dict[name]
            rows[: len(saved)] = saved[: len(rows)]  # the others are those of an empty buffer
        self.tails = {e: (row, step) for e, row, step in state_dict["tails"].tolist()}
        self.generator.set_state(state_dict["generator"].cpu())
        self._starts = None

    def _empty(self) -> None:
        self._forget(torch.arange(len(self.valid), device=self.valid.device))
        self._starts = None

    def dumps(self, path: Any) -> None:
        raise NotImplementedError("Use state_dict and mpc_sgft.storage.checkpoint.")

    def loads(self, path: Any) -> None:
        raise NotImplementedError("Use load_state_dict and mpc_sgft.storage.checkpoint.")


class SliceBuffer:
    """Ring buffer of transitions that returns slices [B, T]; build it with `make_buffer`."""

    def __init__(self, capacity: int, slice_len: int, batch_size: int, seed: int, device: torch.device) -> None:
        self.capacity, self.device = capacity, device
        self.sampler = SliceSampler(capacity, slice_len, seed, device)
        storage = LazyTensorStorage(capacity, device=device)
        self._replay = TensorDictReplayBuffer(
            storage=storage, sampler=self.sampler, batch_size=batch_size, priority_key="none"
        )

    def extend(self, steps: TensorDictBase) -> int:
        """Store transitions [N, T] (environment first, time second) or [T]; returns how many were kept.

        Rows whose ("next", "invalid") is true are dropped: the physics behind them was unstable.

        Raises:
            ValueError: If one call brings more rows than the buffer holds.
        """
        flat = steps.reshape(-1).copy()
        invalid = flat.get(("next", "invalid"), None)
        if invalid is not None and invalid.any():
            flat = flat[~invalid.reshape(-1)]
        if len(flat) > self.capacity:
            raise ValueError(
                f"{len(flat)} transitions do not fit a buffer of {self.capacity}; extend in smaller pieces."
            )
        if len(flat):
            index = torch.as_tensor(self._replay.extend(flat, update_priority=False))
            self.sampler.link(*(x.to(self.device) for x in (index, flat["episode"], flat["step"])))
        return len(flat)

    def sample(self) -> TensorDictBase:
        """Slices of consecutive steps, [B, T], uniform over the possible starts."""
        return self._replay.sample()

    def __len__(self) -> int:
        return len(self._replay)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on with the same samples; plain tensors and numbers."""
        data = self._replay[:].flatten_keys("/") if len(self) else {}
        writer = self._replay.writer.state_dict()
        return {"data": {k: v.clone() for k, v in data.items()}, "writer": writer, "sampler": self.sampler.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict`, of a buffer of the same capacity or of one that was not full and whose rows fit.

        Raises:
            ValueError: If the capacities differ otherwise.
        """
        rows = len(state["sampler"]["valid"])
        n = len(next(iter(state["data"].values()))) if state["data"] else 0
        if rows != self.capacity and (n == rows or n > self.capacity):
            raise ValueError(
                f"The saved buffer has {n} of {rows} rows, this one room for {self.capacity}; keep the capacity when "
                "resuming."
            )
        self._replay.empty()
        if n:
            data = TensorDict(state["data"], batch_size=[n]).unflatten_keys("/")
            self._replay.storage.set(torch.arange(n), data.to(self.device))  # type: ignore[arg-type]
        self._replay.writer.load_state_dict(state["writer"])
        self.sampler.load_state_dict(state["sampler"])


def make_buffer(
    capacity: int, slice_len: int, batch_size: int, seed: int, device: torch.device | str = "cpu"
) -> SliceBuffer:
    """Replay of at most `capacity` transitions [B, T] = [batch_size, slice_len].

    Args:
        capacity: Transitions kept; the oldest go first.
        slice_len: Consecutive steps of a slice [T]; shorter episodes contribute nothing.
        batch_size: Slices of a batch [B].
        seed: Of the sampling.
        device: Where the transitions are kept: on that of the learner a batch need not travel.

    Raises:
        ValueError: If capacity < slice_len or a number is not positive.
    """
    if not 1 <= slice_len <= capacity or batch_size < 1:
        raise ValueError(
            "make_buffer wants 1 <= slice_len <= capacity and batch_size >= 1, "
            f"got slice_len={slice_len}, capacity={capacity}, batch_size={batch_size}."
        )
    return SliceBuffer(capacity, slice_len, batch_size, seed, torch.device(device))
