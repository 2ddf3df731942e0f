"""What a run leaves on disk: weights to deploy, and the exact state to resume.

`save` writes the model as safetensors, with everything needed to rebuild it in the header. `save_state` writes whatever
a loop needs to go on with the same numbers. Both replace the earlier file only when the new one is complete on disk: a
full disk or a kill leaves the earlier one.
"""

import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import safetensors.torch
import torch
from omegaconf import DictConfig, OmegaConf
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.storage.whole_file import write_whole

DIGEST_BYTES = 32  # SHA-256 in front of a saved state
FORMAT = 1  # of the weights file; raise it when an old file can no longer be read
EARLIER_RANGE = 20.0  # [reward] where a header has none: a temperature of 0.1 is then the 2.0 reward units of before
WEIGHTS = Path("checkpoint") / "model.safetensors"  # inside a run folder


class CheckpointError(ValueError):
    """A checkpoint cannot be used. The message says which file, what was expected, what was found and what to do."""


class Loaded(NamedTuple):
    """A checkpoint, ready to act."""

    model: WorldModel
    meta: dict[str, Any]  # as `describe` made it


def describe(cfg: DictConfig, model: WorldModel, extra: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Header of a checkpoint: task, sizes, history, discount, format version, the whole config, and `extra`."""
    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    for path in ("run_dir", "resume", "checkpoint"):  # where it was made is nobody else's business
        config.pop(path, None)
        config["overrides"] = [x for x in config.get("overrides", []) if not x.startswith(f"{path}=")]
    return {
        "format": FORMAT,
        "task": str(cfg.chosen.task),
        "history": int(cfg.task.history),
        "discount": float(cfg.task.discount),
        "sizes": dict(model.sizes),
        "value_range": float(model.value_range),
        "residual": model.dynamics.residual is not None,
        "command_map": model.dynamics.command is not None,
        "command_band": model.dynamics.banded is not None,
        "observation_map": None if model.observation_map is None else model.observation_map.points,
        "suspicion": model.dynamics.joint is not None,
        "config": config,
        **(extra or {}),
    }


def save(path: Path | str, model: WorldModel, meta: Mapping[str, Any]) -> None:
    """Write the weights and their header to `path` (.safetensors).

    Raises:
        OSError: If the file cannot be written; an earlier file is untouched.
    """
    tensors = {name: x.detach().cpu().contiguous() for name, x in model.state_dict().items()}
    header = {"mpc_sgft": json.dumps(dict(meta)), "sha256": _digest(tensors)}
    write_whole(Path(path), safetensors.torch.save(tensors, metadata=header))


def load(
    path: Path | str,
    *,
    tasks: Sequence[str] = (),
    sizes: Mapping[str, Any] | None = None,
    device: torch.device | str = "cpu",
) -> Loaded:
    """Rebuild a model from a run folder or a .safetensors file.

    Args:
        path: File, or a run folder that holds checkpoint/model.safetensors.
        tasks: Names of the tasks for one of which it must have been trained; any if empty.
        sizes: Model sizes that it must have, e.g. {"obs_dim": 16}; others are free.
        device: Where the model goes.

    Raises:
        CheckpointError: If the file is missing, unreadable or corrupt, or for another task, size or format.
    """
    file = Path(path) / WEIGHTS if os.path.isdir(path) else Path(path)
    missing = f"No checkpoint at {file}. Give a run folder of a finished pretrain, or a .safetensors file."
    _opened(file, missing).close()  # safe_open says of a file that may not be read that there is none
    try:
        with safe_open(file, framework="pt") as opened:
            header = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118, not a dict
        meta = json.loads(header["mpc_sgft"])
        found = {"format": meta["format"], "task": meta["task"], **meta["sizes"]}
    except KeyError as err:
        raise CheckpointError(f"{file} has no {err} in its header: it was not written by mpc_sgft. {_AGAIN}") from err
    except (SafetensorError, ValueError, TypeError) as err:
        raise CheckpointError(f"{file} is corrupt ({err}). {_AGAIN}") from err
    own = meta["task"] if meta["task"] in tasks else next(iter(tasks), meta["task"])
    expected = {"format": FORMAT, "task": own, **(sizes or {})}
    for key, value in expected.items():
        if found.get(key) != value:
            raise CheckpointError(
                f"{file} does not fit: expected {key}={value!r}, found {key}={found.get(key)!r}. "
                "Choose the task and model it was trained with, or another checkpoint."
            )
    if header.get("sha256") != _digest(tensors):
        raise CheckpointError(f"{file} is corrupt: its tensors do not match the checksum in its header. {_AGAIN}")
    try:
        model = WorldModel(**meta["sizes"])
        if meta.get("residual"):
            model.add_residual()
        if meta.get("command_map"):
            model.add_command_map()
        if meta.get("command_band"):
            model.add_command_band()
        if meta.get("observation_map") is not None:
            model.add_observation_map(meta["observation_map"])
            tensors.setdefault("observation_map.suspects", torch.tensor(False))  # the first ones suspected nothing
        if meta.get("suspicion"):
            model.add_suspicion()
        model.load_state_dict(tensors)
        model.value_range = float(meta.get("value_range", EARLIER_RANGE))
    except (TypeError, ValueError, RuntimeError) as err:
        raise CheckpointError(f"{file} does not fit the sizes in its own header ({err}). {_AGAIN}") from err
    return Loaded(model.to(device), meta)


def save_state(path: Path | str, state: Mapping[str, Any]) -> None:
    """Write the exact state of a loop: nested dicts, lists and tuples of tensors, numbers and strings.

    Raises:
        OSError: If the file cannot be written; an earlier file is untouched.
    """
    payload = io.BytesIO()
    torch.save(dict(state), payload)
    data = payload.getvalue()
    write_whole(Path(path), hashlib.sha256(data).digest() + data)


def load_state(path: Path | str) -> dict[str, Any]:
    """Read what `save_state` wrote; runs no code from the file.

    Raises:
        CheckpointError: If there is no such file, it cannot be read or is corrupt.
    """
    file = Path(path)
    with _opened(file, f"No saved state at {file}. Start the run again without --resume.") as opened:
        raw = opened.read()
    digest, data = raw[:DIGEST_BYTES], raw[DIGEST_BYTES:]
    if hashlib.sha256(data).digest() != digest:
        raise CheckpointError(f"{file} is corrupt: its content does not match its checksum. {_AGAIN}")
    return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)


_AGAIN = "Use another checkpoint or train again."


def _opened(file: Path, missing: str) -> BinaryIO:
    """A file to be read; `missing` is what to say where there is none."""
    try:
        return open(file, "rb")
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as err:
        raise CheckpointError(missing) from err
    except OSError as err:
        message = f"{file} cannot be read: {err.strerror}. Make it readable, or use another checkpoint or run."
        raise CheckpointError(message) from err


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, x in sorted(tensors.items()):
        digest.update(f"{name} {tuple(x.shape)} {x.dtype}".encode())
        digest.update(x.numpy().tobytes())
    return digest.hexdigest()
