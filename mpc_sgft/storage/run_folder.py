"""A run on disk: where it goes, what is written when it starts, and links to the newest one.

runs/<task>/<time>/   config.yaml  versions.json  and what the loop adds
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mpc_sgft import __version__
from mpc_sgft.command.errors import AGAIN, UserError, disk_error
from mpc_sgft.storage.whole_file import write_whole

PACKAGES = "torch torchrl tensordict mujoco gymnasium numpy scipy hydra-core safetensors mcap rerun-sdk".split()
SUMMARY = "summary.json"  # inside a run folder


def start(cfg: DictConfig, root: Path | str = "runs") -> Path:
    """Make the folder of a new run, or return that of a resumed one, as it is (`keep_told`).

    `cfg.resume` names the folder to go on with. Otherwise it is `cfg.run_dir`, exactly, or <root>/<task>/<time>. A new
    folder gets config.yaml and versions.json, and `latest` links in <root> and <root>/<task> if it lies inside <root>
    and is no dry run.

    Args:
        cfg: Config of the run, as cli.py makes it (`chosen.task`, `run_dir`, `resume`).
        root: Where runs without `run_dir` go.

    Returns:
        The folder, absolute.

    Raises:
        UserError: If the folder already holds something, or cannot be written.
    """
    if cfg.resume is not None:
        return Path(cfg.resume).resolve()
    root = Path(root).resolve()
    task = str(cfg.chosen.task)
    folder = None
    try:
        folder = _new_folder(cfg.run_dir, root / task)
        write_whole(folder / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True).encode())
        (folder / "versions.json").write_text(json.dumps(versions(), indent=2) + "\n")
    except OSError as err:
        place = folder or cfg.run_dir or root / task
        reason = disk_error(err) or f"{err.filename or place}: {err.strerror}. Choose another place with run_dir=..."
        raise UserError(reason) from err
    if folder.is_relative_to(root) and not OmegaConf.select(cfg, "backend.dry_run", default=False):
        for link in (root / "latest", root / task / "latest"):
            _link(link, folder)
    return folder


def keep_told(cfg: DictConfig, folder: Path) -> None:
    """Write what a resumed run is told now into its config.yaml, so that it holds the next time, and go on with it.

    A summary that is there is taken away: it is of a run that was finished. Call it when all is built and loaded: what
    is refused until then changes nothing. A new run's file stays.

    Raises:
        UserError: If it cannot be written.
    """
    if cfg.resume is None:
        return
    told = OmegaConf.to_yaml(OmegaConf.merge(cfg, {"resume": None}), resolve=True)
    try:
        write_whole(folder / "config.yaml", told.encode())
        (folder / SUMMARY).unlink(missing_ok=True)
    except OSError as err:
        raise UserError(disk_error(err, AGAIN) or f"{err.filename}: {err.strerror}. {AGAIN}") from err


def _new_folder(run_dir: str | None, parent: Path) -> Path:
    if run_dir is not None:
        folder = Path(run_dir).resolve()
        if folder.is_dir() and any(folder.iterdir()):
            raise UserError(
                f"{run_dir} already holds files and stays as it is. Go on with it (--resume) or give another run_dir=."
            )
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    parent.mkdir(parents=True, exist_ok=True)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ["", *(f"_{n}" for n in range(2, 1000))]:  # several runs may start in the same second
        try:
            (parent / (stamp + suffix)).mkdir()
        except FileExistsError:
            continue
        return parent / (stamp + suffix)
    raise UserError(f"{parent} holds 999 runs of this second. Give a run_dir=.")


def _link(link: Path, folder: Path) -> None:
    """Point a link at the folder, in one step, so that a reader never finds it missing."""
    if link.exists() and not link.is_symlink():
        raise UserError(f"{link} is not a link to the newest run but a file or folder of its own. Move it away.")
    link.parent.mkdir(parents=True, exist_ok=True)
    fresh = link.with_name(f".latest-{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(os.path.relpath(folder, link.parent), target_is_directory=True)
    fresh.replace(link)


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """summary.json, whole or not at all: who finds it takes the run as finished."""
    write_whole(folder / SUMMARY, (json.dumps(summary, indent=2) + "\n").encode())


def versions() -> dict[str, Any]:
    """What this run is made of: versions of Python and the packages, the commit if there is one, the machine."""
    found: dict[str, Any] = {"mpc_sgft": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found | {"commit": commit(), "platform": platform.platform(), "cpu": cpu_name(), "cpu_count": os.cpu_count()}


def commit() -> str | None:
    """Commit of the source tree, with "+changes" if it differs; None where there is no git checkout."""
    here = Path(__file__).resolve().parents[2]
    if not (here / ".git").exists():
        return None
    try:
        head = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, timeout=10, check=True
        )
        dirty = subprocess.run(
            ["git", "status", "--porcelain", "--untracked-files=no"],
            cwd=here,
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return head.stdout.strip() + ("+changes" if dirty.stdout.strip() else "")


def cpu_name() -> str:
    """The processor's own name."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
