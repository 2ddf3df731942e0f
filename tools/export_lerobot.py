"""Write the real episodes of a deployment as a LeRobotDataset (format v3.0, huggingface/lerobot).

    python -m tools.export_lerobot runs/push/latest datasets/push

| feature                         | one row a control step                                                             |
|---------------------------------|------------------------------------------------------------------------------------|
| `observation.state` [O]         | what the task observes at the step's beginning; history is in the rows before      |
| `action` [A]                    | -1 to 1, as asked for                                                              |
| `next.action_sent` [A]          | after the interface's limits                                                       |
| `next.reward` [1]               | of the step                                                                        |
| `next.success` `next.done` [1]  | whether the goal holds at the step's end, and whether the episode ended with it    |
| `next.invalid` [1]              | whether the step must not be learned from                                          |
| `joints.qpos` `joints.qvel`     | the machine's joints in the sample nearest to the step's beginning [rad, rad/s]    |
| `joints.target` `joints.torque` | what the actuators were told and what they exerted in that sample                  |
| `aborted` [1]                   | in every row of an episode that a fault ended early, or whose recording is cut off |

The lerobot package pins another PyTorch and wants Python 3.12, so the writing is done by write_lerobot.py in an
environment of its own, which uv makes on first use (a few GB, once). Exit codes: 0 written, 2 something to mend.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hydra.utils import instantiate

from envs.task import AbstractTask
from mpc_sgft.command.errors import UserError, disk_error, from_config
from mpc_sgft.diagnose.deployments.recordings import joint_columns, run_config
from mpc_sgft.storage.episode_file import Episode, read_episode

WRITER = Path(__file__).with_name("write_lerobot.py")
JOINTS = {"joints.qpos": "qpos", "joints.qvel": "qvel", "joints.target": "ctrl", "joints.torque": "force"}


class Export(NamedTuple):
    """What the writer gets.

    Attributes:
        header: repo_id, fps, task in words, robot, and names: feature -> a name for each of its entries.
        episodes: Feature -> [T, size], one dictionary an episode.
        notes: What was lost, left out or marked, in words.
    """

    header: dict[str, Any]
    episodes: list[dict[str, np.ndarray]]
    notes: list[str]


def read_run(run: Path, *, text: str | None = None, only_complete: bool = False) -> Export:
    """The episodes of a run folder as LeRobot features.

    Args:
        run: Folder of a deployment, on either backend.
        text: The task in words; None: the first line of the task's docstring.
        only_complete: Whether to leave out aborted and cut-off episodes.

    Raises:
        UserError: If the folder is not that of a deployment, or holds no usable episode.
    """
    try:
        cfg = run_config(run).task.env
    except UserError as error:
        raise UserError(str(error).removeprefix("--run ")) from error
    with from_config("task"):
        task: AbstractTask = instantiate(cfg, _convert_="all")
    if abs(1 / task.control_dt - round(1 / task.control_dt)) > 1e-6:
        raise UserError(f"{run}: control_dt is {task.control_dt} s; the format wants whole frames a second.")
    paths = sorted(p for p in (run / "episodes").glob("*.mcap") if p.stem.isdigit())
    if not paths:
        raise UserError(f"{run}: no episodes in {run / 'episodes'}. Deploy at least one rollout first.")
    episodes, notes, metadata = [], [], {}
    for path in paths:
        try:
            episode = read_episode(path)
        except ValueError as error:
            raise UserError(f"{error} Take it out of the run folder.") from error
        if (found := episode.metadata.get("task", task.name)) != task.name:
            raise UserError(f"{path}: recorded on task {found!r}, the run's config says {task.name!r}.")
        rows, said = features(episode, task, only_complete=only_complete)
        notes += [f"{path.name}: {note}" for note in said]
        if rows:
            episodes.append(rows)
            metadata = episode.metadata
    if not episodes:
        raise UserError(f"{run}: none of {len(paths)} episodes can be exported. {notes[-1]}.")
    header = {
        "repo_id": f"mpc_sgft/{task.name}",
        "fps": round(1 / task.control_dt),
        "task": text or (type(task).__doc__ or task.name).strip().splitlines()[0],
        "robot": metadata.get("backend", "sim"),
        "names": names(task, metadata),
    }
    return Export(header, episodes, notes)


def features(episode: Episode, task: AbstractTask, *, only_complete: bool) -> tuple[dict[str, np.ndarray], list[str]]:
    """One episode's features, each [T, size], and what there is to say about it; no features if it is left out."""
    data, joints = episode.transitions, episode.joints
    fault = episode.lost or (episode.outcome or {}).get("aborted")
    notes = [f"aborted: {fault}"] if fault else []
    if fault and only_complete:
        return {}, [*notes, "left out"]
    if not data:
        return {}, [*notes, "left out, it has no whole step"]
    if any(key not in joints for key in ("time", *JOINTS.values())):
        return {}, [*notes, "left out, it has no joint samples"]
    count = len(data["step"])
    begins = np.concatenate([[0.0], data["time"][:-1]])
    away = np.abs(joints["time"][None] - begins[:, None])  # [T, S]
    if (worst := away.min(1).max()) > task.control_dt / 2:
        notes.append(f"the nearest joint sample is up to {worst:.2f} s away")
    columns = {
        "observation.state": data["observation"][:, : len(task.observation_names)],
        "action": data["action"],
        "next.action_sent": data["action_sent"],
        "next.reward": data["reward"],
        "next.success": data["success"],
        "next.done": data["terminated"] | data["truncated"],
        "next.invalid": data["invalid"],
        **{name: joints[kind][away.argmin(1)] for name, kind in JOINTS.items()},
        "aborted": np.full(count, bool(fault)),
    }
    for kind in ("qpos", "qvel"):  # of the machine, not of what it handles
        columns[f"joints.{kind}"] = columns[f"joints.{kind}"][:, joint_columns(task, kind)]
    rows = {key: a.reshape(count, -1).astype(bool if a.dtype == bool else np.float32) for key, a in columns.items()}
    whole = np.all([np.isfinite(array).all(1) for array in rows.values()], axis=0)
    if not whole.all():
        count = int(np.argmin(whole))
        notes.append(f"{count} of {len(whole)} steps kept, the next one holds a number that is not finite")
    return {key: array[:count] for key, array in rows.items()} if count else {}, notes


def names(task: AbstractTask, metadata: dict[str, Any]) -> dict[str, list[str]]:
    """Feature -> a name for each entry."""
    model = task.spec().compile()
    at = {int(model.jnt_qposadr[i]): model.joint(i).name for i in range(model.njnt)}
    joints = [at[i] for i in joint_columns(task, "qpos")]
    actions = [f"action_{i}" for i in range(task.action_dim)]
    single = ("next.reward", "next.success", "next.done", "next.invalid", "aborted")
    return {
        "observation.state": list(task.observation_names),
        "action": actions,
        "next.action_sent": actions,
        "joints.qpos": joints,
        "joints.qvel": joints,
        "joints.target": metadata["actuator_names"],
        "joints.torque": metadata["actuator_names"],
        **{name: [name.rpartition(".")[2]] for name in single},
    }


def write(export: Export, out: Path) -> dict[str, Any]:
    """Write a dataset through lerobot's own API; the folder appears when it is whole, or not at all.

    Returns:
        What could be read back: `episodes` and `frames`, and the `format` they are in.

    Raises:
        UserError: If the folder is in use, or the environment with lerobot cannot be had.
    """
    check_free(out)
    stacked = {name: np.concatenate([e[name] for e in export.episodes]) for name in export.episodes[0]}
    lengths = np.array([len(e["action"]) for e in export.episodes])
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, header=json.dumps(export.header), lengths=lengths, **stacked)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as scratch:
        made = Path(scratch) / "dataset"
        done = subprocess.run([*uv_run(), str(WRITER), str(made)], input=stream.getvalue(), capture_output=True)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
            why = next((line for line in said if line.startswith("error:")), said[-1]).removeprefix("error: ")
            raise UserError(f"lerobot's environment (Python 3.12 or 3.13, and once the network) failed: {why}")
        if out.exists():
            out.rmdir()
        made.rename(out)
    return json.loads(done.stdout.decode().splitlines()[-1])


def check_free(out: Path) -> None:
    """Raises UserError unless the folder is empty or not there."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UserError(f"{out} is not an empty folder; nothing is overwritten. Give a new one.")


def uv_run() -> list[str]:
    """The command that runs a script in the environment that its head describes."""
    uv = shutil.which("uv", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    if uv is None:
        raise UserError("uv is needed to make the lerobot environment: pip install uv")
    index = os.environ.get("PIP_INDEX_URL")
    return [uv, "run", "--quiet", *(["--default-index", index] if index else []), "--script"]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder of a deployment")
    parser.add_argument("out", type=Path, help="folder of the dataset, new or empty")
    parser.add_argument("--task", help="the task in words; default: the first line of its docstring")
    parser.add_argument("--only-complete", action="store_true", help="leave out aborted and cut-off episodes")
    args = parser.parse_args(argv)
    try:
        check_free(args.out)
        export = read_run(args.run, text=args.task, only_complete=args.only_complete)
        print("\n".join(export.notes), file=sys.stderr, end="\n" * bool(export.notes))
        done = write(export, args.out)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {disk_error(error) or f'{error.filename}: {error.strerror}'}", file=sys.stderr)
        return 2
    print(
        f"{done['episodes']} episodes, {done['frames']} frames in {args.out}, LeRobotDataset {done['format']}. To load:"
    )
    print(f'  LeRobotDataset("{export.header["repo_id"]}", root="{args.out.resolve()}")')
    return 0


if __name__ == "__main__":
    sys.exit(main())
