"""Work on a CUDA device that is recorded once and replayed: one launch of a graph in place of hundreds of kernels."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

WARM_UP = 2  # calls that run as they are before one is recorded: libraries prepare themselves in the first ones

Outputs = Any  # tensors, in whatever holds them


class Recorded(NamedTuple):
    """A graph, and the tensors that it reads and writes."""

    graph: torch.cuda.CUDAGraph
    generator: torch.Generator
    inputs: list[Tensor]
    outputs: Outputs


class CudaGraphs:
    """Records pieces of work, each under a key, and replays them.

    A graph reads and writes the memory that it was recorded with. Whatever decides what the work does, and where its
    tensors lie, but for its inputs, belongs into the key: see `addresses`.

    Args:
        most: Recordings kept; the oldest go first.
    """

    def __init__(self, most: int = 8) -> None:
        self.most = most
        self._calls: dict[Hashable, int] = {}
        self._recorded: dict[Hashable, Recorded] = {}

    def clear(self) -> None:
        """Forget everything: something that recordings refer to has moved."""
        self._calls.clear()
        self._recorded.clear()

    def __call__(
        self, key: Hashable, work: Callable[..., Outputs], inputs: Sequence[Tensor], generator: torch.Generator
    ) -> Outputs:
        """`work(generator, *inputs)`; what it returns is overwritten by the next call with this key.

        Args:
            key: Of the recording.
            work: Asks nothing of the device and does nothing on the host that the next call would need.
            inputs: On the device, of the same shapes at each call.
            generator: What `work` draws from, beside the device's default generator; it ends where it would without.

        Raises:
            RuntimeError: If `work` cannot be recorded.
        """
        with torch.cuda.device(inputs[0].device):
            return self._run(key, work, inputs, generator)

    def _run(
        self, key: Hashable, work: Callable[..., Outputs], inputs: Sequence[Tensor], generator: torch.Generator
    ) -> Outputs:
        found = self._recorded.get(key)
        if found is None:
            calls = self._calls[key] = self._calls.pop(key, 0) + 1
            if calls <= WARM_UP:
                _forget_oldest(self._calls, 8 * self.most)
                return _aside(work, inputs, generator)
            found = self._recorded[key] = _record(work, inputs)
            _forget_oldest(self._recorded, self.most)
        for there, here in zip(found.inputs, inputs, strict=True):
            there.copy_(here)
        found.generator.set_state(generator.get_state())
        found.graph.replay()
        generator.set_state(found.generator.get_state())
        return found.outputs


def _forget_oldest(kept: dict[Hashable, Any], most: int) -> None:
    while len(kept) > most:
        del kept[next(iter(kept))]


def _aside(work: Callable[..., Outputs], inputs: Sequence[Tensor], generator: torch.Generator) -> Outputs:
    """Run on a stream of its own, as a recording does."""
    aside, now = torch.cuda.Stream(), torch.cuda.current_stream()
    aside.wait_stream(now)
    with torch.cuda.stream(aside):
        outputs = work(generator, *inputs)
    now.wait_stream(aside)
    return outputs


def _record(work: Callable[..., Outputs], inputs: Sequence[Tensor]) -> Recorded:
    graph, own = torch.cuda.CUDAGraph(), [x.clone() for x in inputs]
    generator = torch.Generator(own[0].device)
    graph.register_generator_state(generator)  # type: ignore[attr-defined]
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            outputs = work(generator, *own)
    except RuntimeError as error:
        raise RuntimeError(
            f"This cannot be recorded as a CUDA graph ({error}). Leave recording out: planner.cuda_graph=false, "
            "train.agent.cuda_graph=false."
        ) from error
    return Recorded(graph, generator, own, outputs)


def addresses(module: nn.Module) -> tuple[int, ...]:
    """Where the parameters and buffers of a module lie."""
    return tuple(x.data_ptr() for x in (*module.parameters(), *module.buffers()))
