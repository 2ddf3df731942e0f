"""A short film of one adaptation: the same start before and after a few real rollouts, side by side, as a GIF.

    MUJOCO_GL=egl python -m tools.film --out docs/adapt.gif
    MUJOCO_GL=egl python -m tools.film --run runs/push/latest --out adapt.gif
    MUJOCO_GL=egl python -m tools.film --task hammer --gap hammer_real --out docs/tasks/hammer.gif

With --task it is the task's scripted policy, in simulation and in a gap. Without --task and --run it deploys as
`make demo` does, but for three rollouts. The start is that of the first evaluation episode, whatever comes of it: the
verdicts and the numbers in the captions are what was measured. MUJOCO_GL=egl draws without a screen (`make system`
installs what that needs); leave it out where there is one.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from PIL import Image, ImageDraw, ImageFont

from envs.env import ControlEnv
from envs.task import AbstractTask
from envs.tasks.planar import PlanarTask
from envs.tasks.push import Push
from mpc_sgft.command import compose
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import Act, collect, planner_policy, score, scripted_policy
from mpc_sgft.runs.pretrain import EVAL_SEED

ROLLOUTS = 3
SCRIPTED = 64  # episodes that a scripted policy's success is counted in
FRAMES_A_STEP = 2  # pictures of a control period
PERIOD = 0.08  # [s] between pictures at least, where control periods are shorter
HOLD = 2.5  # [s] that the last picture stays
PANEL = (320, 316)  # [pixel] width and height of one picture
BAR = 52  # [pixel] height of the captions above it
TORSO, BESIDE = 1, 4.5  # body that the camera follows where a machine walks, and from how far [m]
BACKGROUND, INK = (38, 44, 54), (235, 238, 242)
GOOD, BAD = (106, 209, 133), (240, 128, 112)
COLORS = 256  # of the GIF, chosen once for all pictures: what does not move then costs nothing


class Episode(NamedTuple):
    """What one episode looked like and came to."""

    qpos: NDArray[np.float64]  # [T * FRAMES_A_STEP, nq]
    success: bool


class Panel(NamedTuple):
    """One half of the film."""

    pictures: NDArray[np.uint8]  # [n, height, width, 3]
    title: str
    numbers: str  # what was measured over many episodes
    success: bool | None  # None: a task in which the return counts


def episode(env: ControlEnv, act: Act, seed: int, steps: int) -> Episode:
    """Drive one episode of an environment of size 1 and keep its positions, several a control period."""
    env.set_seed(seed)
    state, fresh, kept = env.reset(), torch.ones(1, dtype=torch.bool), []
    for _ in range(steps):
        state["action"] = act(state["observation"], fresh)
        state, fresh = env.step(state)["next"], torch.zeros(1, dtype=torch.bool)
        qpos = env.backend.samples()["qpos"]
        kept.append(qpos[np.linspace(0, len(qpos) - 1, FRAMES_A_STEP + 1).round().astype(int)[1:]])
    return Episode(np.concatenate(kept), bool(state["success"]))


def camera_of(task: AbstractTask) -> mujoco.MjvCamera:
    """The camera from where a viewer looks at the task."""
    view, camera = task.view(), mujoco.MjvCamera()
    if view.eye is None or view.target is None:
        raise ValueError(f"task {task.name} says no view: give its view() an eye and a target")
    along = np.subtract(view.target, view.eye)
    camera.lookat, camera.distance = view.target, float(np.linalg.norm(along))
    camera.azimuth = float(np.degrees(np.arctan2(along[1], along[0])))
    camera.elevation = float(np.degrees(np.arcsin(along[2] / camera.distance)))
    return camera


def draw(task: AbstractTask, qpos: NDArray[np.float64], camera: mujoco.MjvCamera) -> NDArray[np.uint8]:
    """Pictures [n, height, width, 3] of positions [n, nq] in the task's scene, in front of a plain background."""
    spec = task.spec()
    rgb = np.array(BACKGROUND) / 255
    spec.add_texture(
        name="background",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=rgb,
        rgb2=rgb,
        width=8,
        height=8,
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, PANEL[1], PANEL[0]) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        pictures = []
        for row in qpos:
            data.qpos = row
            mujoco.mj_forward(model, data)
            if isinstance(task, PlanarTask):  # it walks away
                camera.lookat[0], camera.distance = data.xpos[TORSO, 0], BESIDE
            renderer.update_scene(data, camera)
            pictures.append(renderer.render())
    return np.stack(pictures)


def frames(panels: list[Panel]) -> list[Image.Image]:
    """The pictures of all panels side by side with their captions; the last one says what each came to."""
    count = min(len(panel.pictures) for panel in panels)
    large, small = ImageFont.load_default(17), ImageFont.load_default(13)
    out = []
    for k in range(count):
        frame = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1] + BAR), BACKGROUND)
        pen = ImageDraw.Draw(frame)
        for i, panel in enumerate(panels):
            left = i * PANEL[0]
            frame.paste(Image.fromarray(panel.pictures[k]), (left, BAR))
            pen.text((left + 10, 8), panel.title, INK, large)
            pen.text((left + 10, 30), panel.numbers, INK, small)
            if k == count - 1 and panel.success is not None:
                word, color = ("done", GOOD) if panel.success else ("not done", BAD)
                pen.text((left + PANEL[0] - 10, 42), word, color, large, anchor="rs")
            if i:
                pen.line((left, 0, left, frame.height), INK, 1)
        out.append(frame)
    return out


def save_gif(path: Path, pictures: list[Image.Image], seconds: float) -> None:
    """Write a GIF that runs for `seconds`, holds its last picture and begins again."""
    palette = pictures[-1].quantize(
        COLORS, Image.Quantize.MAXCOVERAGE
    )  # it has every colour: the scene, the captions and the verdicts
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    durations = [round(1000 * seconds / len(flat))] * len(flat)
    durations[-1] = round(1000 * HOLD)
    path.parent.mkdir(parents=True, exist_ok=True)
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=durations, loop=0, optimize=True)


def near_camera(task: AbstractTask) -> mujoco.MjvCamera:
    """Over the table of push, nearer than the viewer's; the viewer's for other tasks."""
    if not isinstance(task, Push):
        return camera_of(task)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = [0.47, 0.0, 0.04], 1.64, 122, -30
    return camera


def film_scripted(task: str, gap: str, out: Path) -> list[Episode]:
    """Film the first evaluation episode of a task's scripted policy, in simulation and in a gap; return both."""
    seen, panels, seconds = [], [], 0.0
    for name, title in (("none", "In its simulator"), (gap, f"In {gap}")):
        cfg = compose.compose("evaluate", [f"task={task}", f"gap={name}"], [])
        build.prepare_process(cfg)
        env, many = build.make_env(cfg, 1), build.make_env(cfg, SCRIPTED)
        found = score(collect(many, scripted_policy(many), seed=EVAL_SEED))
        seen.append(episode(env, scripted_policy(env), EVAL_SEED, env.task.episode_steps))
        walks = isinstance(env.task, PlanarTask)
        worth = f"return {found.episode_return:.0f} of {env.task.episode_steps}" if walks else f"{found.success:.0%}"
        numbers = f"scripted policy, {SCRIPTED} episodes: {worth}"
        done = None if walks else seen[-1].success
        often = max(1, round(PERIOD * FRAMES_A_STEP / env.task.control_dt))
        panels.append(Panel(draw(env.task, seen[-1].qpos[::often], camera_of(env.task)), title, numbers, done))
        seconds = env.task.episode_steps * env.task.control_dt
    save_gif(out, frames(panels), seconds)
    return seen


def film(run: Path, out: Path) -> list[Episode]:
    """Film the first evaluation episode of a deployment, before and after; return both episodes."""
    cfg, summary = OmegaConf.load(run / "config.yaml"), json.loads((run / "summary.json").read_text())
    assert isinstance(cfg, DictConfig)
    trained = OmegaConf.merge(cfg, {"checkpoint": str(run)})
    build.prepare_process(cfg)
    done, curve = summary["real_rollouts"], summary["curve"]
    titles = ("In a world it was not trained for", f"{done} real rollouts later")
    env, seen, panels = build.make_env(cfg, 1), [], []
    for title, rollouts, settings in zip(titles, (0, done), (cfg, trained), strict=True):
        model, planner = build.load_agent(settings)[0].model.eval(), build.make_planner(cfg, env.action_dim)
        seen.append(episode(env, planner_policy(model, planner, EVAL_SEED), EVAL_SEED, env.task.episode_steps))
        numbers = f"success in {summary['evaluation_episodes']} episodes: {curve[str(rollouts)]:.0%}"
        panels.append(Panel(draw(env.task, seen[-1].qpos, near_camera(env.task)), title, numbers, seen[-1].success))
    save_gif(out, frames(panels), env.task.episode_steps * env.task.control_dt)
    return seen


def deploy(folder: Path) -> None:
    """What `make demo` does, but only as many rollouts as the film needs."""
    settings = ["+experiment=demo", f"rollouts={ROLLOUTS}", "log.rerun=false", "quiet=true", f"run_dir={folder}"]
    line = [sys.executable, "-m", "mpc_sgft.deploy", "--backend", "sim", *settings]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/adapt.gif"))
    parser.add_argument("--run", type=Path, help="a run folder of deploy in simulation; default: one is made")
    parser.add_argument("--task", help="film this task's scripted policy instead")
    parser.add_argument("--gap", default="none", help="with --task: where its second half plays")
    args = parser.parse_args()
    if args.task:
        print(args.out, *(f"success {e.success}" for e in film_scripted(args.task, args.gap, args.out)))
        return
    with tempfile.TemporaryDirectory() as scratch:
        run = args.run or Path(scratch) / "run"
        if args.run is None:
            deploy(run)
        before, after = film(run, args.out)
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.1f} MB; success before {before.success}, after {after.success}")


if __name__ == "__main__":
    main()
