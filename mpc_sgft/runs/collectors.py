"""Who collects the rounds of pretraining: this process, or others while this one learns.

A round is asked for before its predecessor is learned from, so that there is time to collect it meanwhile; its policy
is therefore one round old. With as many workers, all give the same numbers.
"""

import multiprocessing
import os
import pickle
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

import torch
from omegaconf import DictConfig

from mpc_sgft.command.errors import UserError
from mpc_sgft.runs.explore import Collected, Explorer, Round, joined


class AbstractCollector(ABC):
    """Collects one round at a time: `start` it, do something else, and fetch its `result`."""

    @abstractmethod
    def start(self, order: Round) -> None:
        """Begin a round; the one before must have been fetched."""

    @abstractmethod
    def result(self) -> Collected:
        """The round that was started, once it is there; asked again it is the same.

        Raises:
            UserError: If it cannot come any more, with what to do.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of what was started for collecting."""


class Inline(AbstractCollector):
    """In this process, before learning goes on."""

    def __init__(self, cfg: DictConfig, sizes: dict) -> None:
        self._explorer = Explorer(cfg, sizes)

    def start(self, order: Round) -> None:
        self._found = self._explorer.collect(order)

    def result(self) -> Collected:
        return self._found

    def close(self) -> None:
        pass


class Process(AbstractCollector):
    """In processes of their own, each with its share of the environments, while this one learns.

    Args:
        cfg, sizes: As `Explorer`.
        workers: How many.
    """

    def __init__(self, cfg: DictConfig, sizes: dict, workers: int = 1) -> None:
        check_workers(workers, cfg.num_envs)
        context = multiprocessing.get_context("spawn")
        self._pools = [
            ProcessPoolExecutor(1, context, initializer=_begin, initargs=(pickle.dumps((cfg, sizes, part, workers)),))
            for part in range(workers)
        ]
        self._coming: list[Future[bytes]] = []
        self._found: Collected | None = None

    def start(self, order: Round) -> None:
        blob, self._found = pickle.dumps(order), None
        with _alive(), _without_interrupts():  # a process that starts here keeps them off until it ignores them
            self._coming = [pool.submit(_collect, blob) for pool in self._pools]

    def result(self) -> Collected:
        if self._found is None:
            with _alive():
                self._found = joined([pickle.loads(future.result()) for future in self._coming])
        return self._found

    def close(self) -> None:
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)


def check_workers(workers: int, num_envs: int) -> None:
    """Raise UserError unless each of the workers has an environment."""
    if not 1 <= workers <= num_envs:
        raise UserError(f"collector.workers={workers}: between 1 and num_envs={num_envs}.")


@contextmanager
def _alive() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool as error:
        raise UserError(
            "a collecting process ended (out of memory? see above). What was saved is there: go on with --resume "
            "RUN_FOLDER, and collector=inline to collect in one process."
        ) from error


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ctrl-C waits until the end; what is started meanwhile does not hear it at all."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_explorer: Explorer  # of a collecting process


def _begin(blob: bytes) -> None:
    """Start of a collecting process. Ctrl-C is the learner's affair, which stops at the end of its round."""
    global _explorer
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_learner, daemon=True).start()
    torch.set_num_threads(1)
    _explorer = Explorer(*pickle.loads(blob), threads=1)


def _end_with_the_learner() -> None:
    """Leave when the learner is gone, killed before it could say so."""
    learner = multiprocessing.parent_process()
    assert learner is not None  # there is one in a collecting process
    learner.join()
    os._exit(1)


def _collect(blob: bytes) -> bytes:
    """A round as bytes: a tensor of its own would hold a shared file for each entry."""
    return pickle.dumps(_explorer.collect(pickle.loads(blob)))
