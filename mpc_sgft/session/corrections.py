"""What a person says of an episode that is over: marked in its file, or set aside to be driven again."""

import csv
import io
import os
from collections.abc import Iterable
from pathlib import Path

from mpc_sgft.storage.episode_file import EpisodeWriter, read_episode, scan
from mpc_sgft.storage.rollout import Press
from mpc_sgft.storage.whole_file import write_whole


def amend(path: Path, presses: Iterable[Press], success: bool | None) -> None:
    """Add keys to an episode, and a mark to its outcome: `success` as marked, `task_success` as the task computed it.

    The file is written anew beside the old one, then they are swapped. An episode that was cut off is closed by it;
    the outcome then says what was lost, as `lost`.

    Args:
        path: Of the episode.
        presses: Keys that are not in the file yet.
        success: The mark; None leaves what is there.
    """
    episode = read_episode(path)
    outcome = episode.outcome or {"success": False, "aborted": "cut off"}
    if episode.lost:
        outcome["lost"] = episode.lost
    if success is not None:
        outcome = {**outcome, "success": success, "task_success": outcome.get("task_success", outcome.get("success"))}
    beside = path.with_suffix(".new")
    beside.unlink(missing_ok=True)  # of a process that was killed here
    with EpisodeWriter(beside, episode.metadata) as writer:
        for topic, time, data in scan(path).messages:
            if topic not in ("/metadata", "/outcome"):
                writer.copy(topic, time, data)
        for press in presses:
            began = episode.metadata.get("began_unix", press.unix)
            writer.key(press.word, time=press.unix - began, unix=press.unix)
        writer.close(outcome)
    os.replace(beside, path)


def set_aside(path: Path) -> Path:
    """Keep an episode that does not count under another name, `<number>.rerecorded<n>.mcap`; the new path."""
    n = 1
    while (other := path.with_suffix(f".rerecorded{n}.mcap")).exists():
        n += 1
    path.rename(other)
    return other


def forget_audit(path: Path, rollout: int) -> None:
    """Drop a rollout's rows from audit.csv."""
    if not path.exists():
        return
    with path.open(newline="") as file:
        rows = [row for row in csv.reader(file) if row[:1] != [str(rollout)]]
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    write_whole(path, text.getvalue().encode())
