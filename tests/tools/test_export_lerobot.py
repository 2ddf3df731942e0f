import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from mpc_sgft.command import compose
from mpc_sgft.diagnose.deployments.recordings import joint_columns
from mpc_sgft.storage.episode_file import EpisodeWriter
from tools import export_lerobot
from tools.export_lerobot import WRITER, main, read_run, uv_run

ROOT = Path(__file__).parents[2]
STEPS, DT, SAMPLES = 6, 0.2, 25
READ_BACK = """
import json, sys
from lerobot.datasets import LeRobotDataset
data = LeRobotDataset("mpc_sgft/push", root=sys.argv[1], delta_timestamps={"next.reward": [0.0, 0.2]})
rows = [data[i] for i in range(len(data))]
columns = {k: [r[k].tolist() for r in rows] for k in rows[0] if k != "task"}
names = {name: feature["names"] for name, feature in data.meta.features.items()}
print(json.dumps({"fps": data.fps, "task": rows[0]["task"], "names": names, "rows": columns}))
"""


def record(path: Path, *, steps: int = STEPS, aborted: str | None = None, broken: int | None = None) -> None:
    """A push episode as the simulator records it; every number says which step or time it belongs to."""
    names = [*(f"joint{i}" for i in range(1, 8)), "puck"]
    actuators = [f"position{i}" for i in range(1, 8)]
    with EpisodeWriter(path, {"task": "push", "joint_names": names, "actuator_names": actuators}) as writer:
        for t in range(steps):
            time = t * DT + np.linspace(DT / SAMPLES, DT, SAMPLES)
            row = {
                "step": t,
                "time": (t + 1) * DT,
                "observation": np.arange(22) + 100.0 * t,
                "action": np.full(2, t / 10),
                "action_sent": np.full(2, t / 20),
                "reward": np.nan if t == broken else float(t),
                "terminated": False,
                "truncated": t == steps - 1,
                "success": t >= 4,
                "invalid": aborted is not None and t == steps - 1,
            }
            widths = {"qpos": 14, "qvel": 13, "ctrl": 7, "force": 7}
            writer.step(row, {"time": time} | {k: time[:, None] + 10.0 * np.arange(n) for k, n in widths.items()})
        writer.close({"success": aborted is None, "aborted": aborted})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Three episodes: a whole one, an aborted one, and one whose file was cut."""
    folder = tmp_path / "run"
    (folder / "episodes").mkdir(parents=True)
    task = OmegaConf.load(ROOT / "configs" / "task" / "push.yaml")
    OmegaConf.save({"command": "deploy", "task": task}, folder / "config.yaml")
    record(folder / "episodes" / "0001.mcap")
    record(folder / "episodes" / "0002.mcap", steps=3, aborted="joint 4 is too fast")
    record(folder / "episodes" / "0003.mcap")
    whole = (folder / "episodes" / "0003.mcap").read_bytes()
    (folder / "episodes" / "0003.mcap").write_bytes(whole[: len(whole) // 2])
    return folder


def test_each_row_is_what_was_known_when_the_step_began(run):
    first = read_run(run).episodes[0]
    assert first["observation.state"][:, 0].tolist() == [100.0 * t for t in range(STEPS)]
    assert first["observation.state"].shape == (STEPS, 4)  # the history is in the rows before
    begin = np.maximum(np.arange(STEPS) * DT, DT / SAMPLES)  # nothing is sampled before the first 8 ms
    np.testing.assert_allclose(first["joints.qpos"][:, 0], begin, atol=1e-6)
    np.testing.assert_allclose(first["joints.torque"][:, 2], begin + 20, atol=1e-5)
    assert first["next.done"].ravel().tolist() == [False] * (STEPS - 1) + [True]
    assert first["next.success"].ravel().tolist() == [t >= 4 for t in range(STEPS)]


def test_every_feature_has_a_name_for_each_entry_and_the_puck_is_no_joint(run):
    export = read_run(run)
    sizes = {name: array.shape[1] for name, array in export.episodes[0].items()}
    assert {name: len(named) for name, named in export.header["names"].items()} == sizes
    assert export.header["names"]["joints.qvel"] == [f"joint{i}" for i in range(1, 8)]


@pytest.mark.parametrize("task", ["push_towel", "rope_peg_in_hole", "hammer"])
def test_joints_are_named_as_those_whose_columns_are_exported(task):
    made = instantiate(compose.compose("evaluate", [f"task={task}"], []).task.env, _convert_="all")
    named = export_lerobot.names(made, {"actuator_names": []})
    for kind in ("qpos", "qvel"):
        assert len(named[f"joints.{kind}"]) == len(joint_columns(made, kind))
    assert named["joints.qpos"][:3] == ["joint1", "joint2", "joint3"]


def test_aborted_and_cut_episodes_are_marked_or_left_out(run):
    export = read_run(run)
    assert [e["aborted"].all() for e in export.episodes] == [False, True, True]
    assert [len(e["action"]) for e in export.episodes[:2]] == [STEPS, 3] and 0 < len(
        export.episodes[2]["action"]
    ) < STEPS
    assert export.episodes[1]["next.invalid"].ravel().tolist() == [False, False, True]
    assert export.notes[0] == "0002.mcap: aborted: joint 4 is too fast"
    assert "0003.mcap" in export.notes[1] and "whole steps kept" in export.notes[1] and "bytes" in export.notes[1]
    assert len(read_run(run, only_complete=True).episodes) == 1


def test_what_is_not_a_number_ends_the_episode(run):
    record(run / "episodes" / "0004.mcap", broken=2)
    export = read_run(run)
    assert len(export.episodes[3]["action"]) == 2 and "2 of 6 steps kept" in export.notes[-1]


def test_mistakes_get_one_clear_line_and_exit_code_2(run, tmp_path, capsys):
    out, full, junk, empty, gone = (tmp_path / name for name in ("out", "full", "junk", "empty", "gone"))
    full.mkdir()
    (full / "precious").touch()
    for folder in (junk, empty, gone):
        shutil.copytree(run, folder)
    (junk / "episodes" / "0002.mcap").write_text("no recording")
    shutil.rmtree(empty / "episodes")
    for path in (gone / "episodes").iterdir():
        path.write_bytes(path.read_bytes()[:300])
    cases = [
        ([tmp_path / "none", out], "no such folder"),
        ([tmp_path, out], "no config.yaml"),
        ([empty, out], "Deploy at least one rollout"),
        ([junk, out], "not an MCAP file"),
        ([gone, out], "none of 3 episodes"),
        ([run, full], "not an empty folder"),
        ([run, full / "precious"], "not an empty folder"),
        ([run, full / "precious" / "out"], "precious"),
    ]
    for arguments, message in cases:
        assert main([str(a) for a in arguments]) == 2, arguments
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert said.startswith("error: ") and message in said, said
    assert not out.exists() and sorted(p.name for p in full.iterdir()) == ["precious"]


def test_without_uv_it_says_so_and_leaves_nothing(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main([str(run), str(tmp_path / "out")]) == 2
    assert "pip install uv" in capsys.readouterr().err and not (tmp_path / "out").exists()


def lerobot_python() -> str:
    """The interpreter that has lerobot, if it was installed before; nothing is downloaded for a test."""
    uv = uv_run()[0]
    made = subprocess.run([uv, "sync", "--offline", "--script", str(WRITER)], capture_output=True, text=True)
    if made.returncode:
        pytest.skip("needs lerobot's environment")
    found = subprocess.run([uv, "python", "find", "--script", str(WRITER)], capture_output=True, text=True, check=True)
    return found.stdout.strip()


@pytest.mark.slow
@pytest.mark.timeout(900)  # lerobot takes 15 s of processor time to import, twice
def test_lerobot_reads_back_what_was_recorded(run, tmp_path, monkeypatch, capsys):
    python, out = lerobot_python(), tmp_path / "sets" / "push"
    monkeypatch.setenv("UV_OFFLINE", "1")
    assert main([str(run), str(out), "--task", "Push it."]) == 0
    export = read_run(run)
    frames = sum(len(e["action"]) for e in export.episodes)
    said = capsys.readouterr().out
    assert f"3 episodes, {frames} frames" in said and f'LeRobotDataset("mpc_sgft/push", root="{out}")' in said
    assert [p.name for p in out.parent.iterdir()] == ["push"]
    env = os.environ | {"HF_HUB_OFFLINE": "1"}
    result = subprocess.run([python, "-c", READ_BACK, str(out)], capture_output=True, text=True, env=env, check=True)
    back = json.loads(result.stdout.splitlines()[-1])
    assert (back["fps"], back["task"]) == (5, "Push it.")
    rewards = back["rows"].pop("next.reward")  # this one was asked for with the step after it
    assert rewards[:2] == [[0.0, 1.0], [1.0, 2.0]] and back["rows"]["next.reward_is_pad"][STEPS - 1] == [False, True]
    ends = np.concatenate([np.arange(len(e["action"])) for e in export.episodes])
    np.testing.assert_allclose(back["rows"]["timestamp"], ends * DT, atol=1e-6)
    for name, named in export.header["names"].items():
        assert back["names"][name] == named
        if name != "next.reward":
            expected = np.concatenate([e[name] for e in export.episodes])
            np.testing.assert_array_equal(np.array(back["rows"][name]).reshape(expected.shape), expected, name)
