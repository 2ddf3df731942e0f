"""The film of an adaptation: its episodes, its captions and its file."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageChops, ImageSequence

from mpc_sgft.command import compose
from mpc_sgft.runs import build
from tools.film import BAR, FRAMES_A_STEP, PANEL, Panel, camera_of, episode, frames, save_gif

ROOT = Path(__file__).parents[2]


def panel(title: str, success: bool | None, count: int = 3) -> Panel:
    return Panel(np.zeros((count, PANEL[1], PANEL[0], 3), np.uint8), title, "success in 50 episodes: 0%", success)


def changed(a: Image.Image, b: Image.Image, box: tuple[int, int, int, int]) -> bool:
    return ImageChops.difference(a.crop(box), b.crop(box)).getbbox() is not None


def test_an_episode_keeps_several_positions_of_each_step() -> None:
    env = build.make_env(compose.compose("deploy", ["+experiment=demo"], []), 1)
    seen = episode(env, lambda observation, fresh: torch.ones(1, 2), seed=7, steps=2)
    again = episode(env, lambda observation, fresh: -torch.ones(1, 2), seed=7, steps=2)
    assert seen.qpos.shape == (2 * FRAMES_A_STEP, env.backend.nominal.nq) and not seen.success
    assert (np.abs(np.diff(seen.qpos[:, :7], axis=0)).max(1) > 1e-3).all()  # the arm moves from picture to picture
    assert np.abs(seen.qpos[0, 7:] - again.qpos[0, 7:]).max() < 1e-6  # the puck starts at the same place


@pytest.mark.parametrize("task", ["push", "hammer", "insert", "rope_peg_in_hole", "walker_walk", "cheetah_run"])
def test_the_camera_stands_where_the_task_says(task: str) -> None:
    task_ = build.make_env(compose.compose("evaluate", [f"task={task}"], []), 1).task
    camera = camera_of(task_)
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    np.testing.assert_allclose(camera.lookat - camera.distance * ahead, task_.view().eye, atol=1e-9)


def test_captions_stand_above_the_pictures_and_the_verdict_on_the_last_one() -> None:
    first, second, last = frames([panel("before", success=False), panel("after", success=True)])
    assert first.size == (2 * PANEL[0], PANEL[1] + BAR)
    halves = [(0, 0, PANEL[0], BAR), (PANEL[0] + 1, 0, 2 * PANEL[0], BAR)]
    for half in halves:
        assert len(first.crop(half).getcolors(10_000)) > 2  # a caption is drawn
        assert not changed(first, second, half) and changed(second, last, half)
    fails, works = frames([panel("same", success=False)])[-1], frames([panel("same", success=True)])[-1]
    assert changed(fails, works, halves[0])
    assert not changed(fails, works, (0, BAR, PANEL[0], PANEL[1] + BAR))  # nothing is drawn over the pictures
    none, *_, last = frames([panel("walks", success=None)])
    assert not changed(none, last, halves[0]), "where the return counts there is no verdict"


def test_the_film_is_as_long_as_its_shorter_half() -> None:
    assert len(frames([panel("before", False, count=5), panel("after", True, count=2)])) == 2


def test_the_file_has_every_picture_and_holds_the_last(tmp_path: Path) -> None:
    pictures = [Image.new("RGB", (40, 30), "navy") for _ in range(4)]
    for k, picture in enumerate(pictures):
        picture.paste("red", (10 * k, 0, 10 * k + 10, 10))
    save_gif(tmp_path / "new" / "film.gif", pictures, seconds=0.8)
    with Image.open(tmp_path / "new" / "film.gif") as gif:
        assert gif.info["loop"] == 0
        assert [picture.info["duration"] for picture in ImageSequence.Iterator(gif)] == [200, 200, 200, 2500]


DRAW = """
import numpy as np
from mpc_sgft.command import compose
from mpc_sgft.runs import build
from tools.film import PANEL, draw, near_camera
env = build.make_env(compose.compose("deploy", [], []), 1)
env.set_seed(0)
env.reset()
moved = env.backend.qpos[:1].copy()
moved[0, 7] += 0.3
here, there = draw(env.task, np.concatenate([env.backend.qpos[:1], moved]), near_camera(env.task)).astype(int)
assert here.shape == (PANEL[1], PANEL[0], 3)
red, green, blue = np.moveaxis(here, 2, 0)
puck, line = (red > green + 60) & (red > blue + 60), (green > red + 40) & (green > blue + 30)
assert puck.sum() > 40 and line.sum() > 500, (puck.sum(), line.sum())
assert (here != there).any(2)[puck].mean() > 0.8
assert np.unique(here[:5].reshape(-1, 3), axis=0).shape == (1, 3)  # one colour behind it all
"""


def test_the_pictures_show_the_puck_and_the_line(mujoco_gl, tmp_path: Path) -> None:
    env = {**os.environ, "MUJOCO_GL": mujoco_gl, "PYTHONPATH": str(ROOT)}
    line = [sys.executable, "-W", "ignore", "-c", DRAW]
    done = subprocess.run(line, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
