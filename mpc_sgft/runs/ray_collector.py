"""Rounds of pretraining collected on a Ray cluster: on this machine, or on many.

Ray's own fault tolerance does the rest: a worker that dies is started again, and repeats its share of the round. A
share is a function of its number and of the policy, so that the numbers are the same as if nothing had happened.
TorchRL's RayCollector is not used because it ends the run when a worker dies.
"""

import hashlib
import logging
import pickle
import platform
import subprocess
import sys
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

import torch
from omegaconf import DictConfig

import mpc_sgft
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs.collectors import AbstractCollector, check_workers
from mpc_sgft.runs.explore import Collected, Explorer, Round, joined

JOINED = 40.0  # [s] within which a cluster must let somebody join
TOKEN_SAYS = "If it asks for a token, this machine needs that of its head as ~/.ray/auth_token."
JOIN = "import ray, sys; ray.init(address=sys.argv[1], log_to_driver=False)"
STORE = 256 * 2**20  # bytes of shared memory of a cluster that is started here
MUST_AGREE, OURS = ("mpc_sgft", "torch", "mujoco"), ("mpc_sgft", "envs", "planners")
ROOT = Path(mpc_sgft.__file__).parents[1]


class Ray(AbstractCollector):
    """Workers of a Ray cluster, each with its share of the environments, while this process learns.

    Args:
        cfg, sizes: As `Explorer`.
        workers: How many.
        address: `host:port` or `auto` of a cluster to join; None starts one here and stops it at the end.

    Raises:
        UserError: If Ray is not installed, nobody answers at the address, the cluster has too few CPUs, or a worker has
            other versions.
    """

    def __init__(self, cfg: DictConfig, sizes: dict, workers: int, address: str | None = None) -> None:
        try:
            import ray
        except ModuleNotFoundError as error:
            raise UserError("collector=ray needs Ray: pip install 'mpc_sgft[ray]'") from error
        check_workers(workers, cfg.num_envs)
        if address is not None:
            _use_token()
            _try(address)
        here = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": STORE}
        try:
            ray.init(
                address=address or "local",
                configure_logging=True,
                logging_level=logging.ERROR,
                log_to_driver=False,
                **({} if address else here),
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            text = " ".join(str(error).split())
            says = f"collector.address={address}: Ray could not join that cluster. {text} {TOKEN_SAYS}"
            raise UserError(says) from error
        self._ray, self._found = ray, None
        cores = int(ray.cluster_resources().get("CPU", 0))
        if workers > cores:  # the last ones would be waited for without end
            ray.shutdown()
            raise UserError(
                f"collector.workers={workers}: the cluster at {address} has {cores} CPUs, and each worker takes one. "
                f"Give collector.workers={cores} or fewer, or let more machines join it."
            )
        actor = ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=-1)(_Worker)
        blobs = [pickle.dumps((cfg, sizes, part, workers)) for part in range(workers)]
        self._workers = [actor.remote(blob) for blob in blobs]
        self._check_versions()

    def start(self, order: Round) -> None:
        blob, self._found = self._ray.put(pickle.dumps(order)), None
        self._coming = [worker.collect.remote(blob) for worker in self._workers]

    def result(self) -> Collected:
        if self._found is None:
            try:
                self._found = joined([pickle.loads(blob) for blob in self._ray.get(self._coming)])
            except self._ray.exceptions.RayError as error:
                raise UserError(
                    f"the Ray cluster gave up: {' '.join(str(error).split())[:300]}. What was saved is there: go on "
                    "with --resume RUN_FOLDER."
                ) from error
        return self._found

    def close(self) -> None:
        for worker in self._workers:
            self._ray.kill(worker)
        self._ray.shutdown()

    def _check_versions(self) -> None:
        ours = versions()
        try:
            found = self._ray.get([worker.versions.remote() for worker in self._workers])
        except self._ray.exceptions.RayError as error:  # its text names the machine
            self.close()
            says = " ".join(str(error).split())[-300:].rstrip(".")
            raise UserError(f"a worker cannot start: {says}. Is mpc_sgft installed there as here?") from error
        for name, theirs in found:
            if theirs != ours:
                self.close()
                raise UserError(f"the worker on {name} has {theirs}, this process {ours}: install the same there.")


def versions() -> dict[str, str]:
    """What must be the same wherever rounds are collected: versions, and a digest of our own code."""
    own = hashlib.sha256()
    for file in sorted(file for package in OURS for file in (ROOT / package).rglob("*.py")):
        own.update(str(file.relative_to(ROOT)).encode() + file.read_bytes())
    return {name: version(name) for name in MUST_AGREE} | {"code": own.hexdigest()[:12]}


class _Worker:
    """What runs on the cluster; nothing is built before its versions were asked."""

    def __init__(self, blob: bytes) -> None:
        torch.set_num_threads(1)
        self._blob = blob

    @cached_property
    def _explorer(self) -> Explorer:
        return Explorer(*pickle.loads(self._blob), threads=1)

    def versions(self) -> tuple[str, dict[str, str]]:
        return platform.node(), versions()

    def collect(self, blob: bytes) -> bytes:
        return pickle.dumps(self._explorer.collect(pickle.loads(blob)))


def _use_token() -> None:
    """With a token at hand, show it to the cluster, as `ray start` does; `ray.init` alone would be turned away."""
    try:  # Ray has no public way once it is imported, which TorchRL does
        from ray._private.authentication import authentication_token_setup
    except ModuleNotFoundError:  # a Ray that knows no tokens
        return
    authentication_token_setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)


def _try(address: str) -> None:
    """Join a cluster in a process of its own, whose log nobody sees: Ray writes a line a second where it may not.

    Raises:
        UserError: If it cannot be joined.
    """
    try:
        done = subprocess.run([sys.executable, "-c", JOIN, address], timeout=JOINED, capture_output=True, text=True)
    except subprocess.TimeoutExpired as error:
        raise UserError(
            f"collector.address={address}: it cannot be joined within {JOINED:.0f} s. {TOKEN_SAYS}"
        ) from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise UserError(f"collector.address={address}: Ray could not join that cluster. {lines[-1]}. {TOKEN_SAYS}")
