# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = ["lerobot[dataset]==0.6.1", "numpy>=2,<3"]
# ///
"""The half of export_lerobot that needs the lerobot package, in an environment of its own: its pins clash with ours.

Reads an .npz on standard input, writes the dataset into a folder that must not exist, opens it again as a user would,
and prints the number of episodes and frames that are in it. export_lerobot starts it; nobody else needs to.
"""

import io
import json
import os
import sys

os.environ["HF_HUB_OFFLINE"] = "1"  # before lerobot: nothing here is on the hub
os.environ["HF_DATASETS_DISABLE_PROGRESS_BARS"] = "1"

import numpy as np  # noqa: E402
from lerobot.datasets import LeRobotDataset  # noqa: E402


def main() -> None:
    folder = sys.argv[1]
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as file:
        data = dict(file)
    header, lengths = json.loads(str(data.pop("header"))), data.pop("lengths")
    features = {
        name: {"dtype": column.dtype.name, "shape": column.shape[1:], "names": header["names"][name]}
        for name, column in data.items()
    }
    dataset = LeRobotDataset.create(
        repo_id=header["repo_id"],
        fps=header["fps"],
        features=features,
        root=folder,
        robot_type=header["robot"],
        use_videos=False,
    )
    for end, length in zip(np.cumsum(lengths), lengths, strict=True):
        for row in range(end - length, end):
            dataset.add_frame({"task": header["task"]} | {name: column[row] for name, column in data.items()})
        dataset.save_episode()
    dataset.finalize()
    back = LeRobotDataset(header["repo_id"], root=folder)
    if (back.num_episodes, len(back)) != (len(lengths), lengths.sum()):
        sys.exit(f"{len(lengths)} episodes were written, {back.num_episodes} read back: {folder}")
    print(json.dumps({"episodes": back.num_episodes, "frames": len(back), "format": back.meta.info.codebase_version}))


if __name__ == "__main__":
    main()
