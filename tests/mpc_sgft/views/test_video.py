"""A film of an episode, in a process of its own: MuJoCo chooses how it draws when it is imported."""

import json
import os
import subprocess
import sys
from itertools import pairwise

import imageio.v2 as imageio
import numpy as np

COMMAND = [sys.executable, "-m", "mpc_sgft.evaluate", "policy=scripted", "episodes=1", "video=true"]


def test_a_film_shows_every_step_of_the_episode(mujoco_gl, tmp_path):
    run = tmp_path / "run"
    environment = os.environ | {"MUJOCO_GL": mujoco_gl}
    done = subprocess.run([*COMMAND, f"run_dir={run}"], capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    frames = imageio.mimread(json.loads((run / "summary.json").read_text())["video"], memtest=False)
    assert len(frames) == 40 and frames[0].shape == (480, 640, 3)
    moving = [np.abs(b[::4, ::4].astype(int) - a[::4, ::4]).mean() for a, b in pairwise(frames)]
    assert min(moving[:10]) > 10 * max(moving[-3:])  # the arm goes to work, and rests when the puck lies at the line
    assert frames[0].std() > 20  # a scene, not one colour


def test_no_way_to_draw_is_a_clear_line(tmp_path):
    environment = os.environ | {"MUJOCO_GL": "glfw"} | {"DISPLAY": ""}
    done = subprocess.run(
        [*COMMAND, f"run_dir={tmp_path / 'run'}"], capture_output=True, text=True, env=environment, timeout=120
    )
    assert done.returncode == 2, done.stderr
    assert "MUJOCO_GL=egl" in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "run").exists()  # nothing was done yet
