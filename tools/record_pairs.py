"""Pictures of a tag on the robot's hand, and the hand's poses: what `calibrate_camera solve` reads."""

import json
import time
from dataclasses import asdict
from importlib import import_module
from itertools import count
from pathlib import Path

import numpy as np

from envs.perception.base import PerceptionError
from envs.perception.camera import Frame, RealSense
from envs.perception.extra import load
from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.whole_file import write_whole

AT_REST = 0.01  # [rad/s] of the fastest joint
WAIT_S = 2.0  # [s] for a picture that was taken after the key was pressed
ASK = "pair {}: guide the hand, let go, press Enter (q and Enter: finish) "


def record(robot_ip: str, serial: str, folder: Path, recording: Path | None = None) -> None:
    """Ask for places until the user has finished; pairs.json is complete after each, and a folder of before goes on.

    Raises:
        UserError: If the robot does not answer (any more), the folder holds something else or pairs of another camera,
            or franky is not installed.
        PerceptionError: If the camera cannot be used.
    """
    pairs = _before(folder, serial)
    try:
        franky = import_module("franky")
    except ModuleNotFoundError:
        raise UserError("recording needs the robot's client: pip install 'mpc_sgft[franka]'.") from None
    camera = RealSense(serial, depth=False, recording=recording)
    try:
        try:
            robot = franky.Robot(robot_ip, realtime_config=franky.RealtimeConfig.Ignore)
        except franky.Exception as err:
            raise UserError(
                f"the robot at {robot_ip} does not answer: {str(err).rstrip('.')}. Is it on, unlocked, and FCI active?"
            ) from err
        while input(ASK.format(len(pairs))).strip().lower() != "q":
            try:
                state = robot.state
            except franky.Exception as err:
                raise UserError(
                    f"the robot at {robot_ip} does not answer any more: {str(err).rstrip('.')}. {len(pairs)} pairs are "
                    f"in {folder}; the same command goes on there."
                ) from err
            if np.abs(state.dq).max() > AT_REST:
                print("the robot moves; wait until it rests")
                continue
            unused = (n for n in map("{:02d}.png".format, count()) if not (folder / n).exists())
            name = next(unused)  # pairs may have been left out
            _save(folder / name, _fresh(camera))
            pairs.append({"base_T_hand": np.asarray(state.O_T_EE.matrix).tolist(), "image": name})
            whole = {"serial": camera.serial, "intrinsics": asdict(camera.intrinsics), "pairs": pairs}
            write_whole(folder / "pairs.json", json.dumps(whole, indent=1).encode())
        print(f"{len(pairs)} pairs in {folder}")
    except EOFError:
        print()
    finally:
        camera.close()


def _before(folder: Path, serial: str) -> list[dict]:
    """Pairs that were recorded in a folder before."""
    if not folder.exists() or not any(folder.iterdir()):
        return []
    try:
        whole = json.loads((folder / "pairs.json").read_text())
        pairs = whole["pairs"] if whole["serial"] == serial else None
    except (FileNotFoundError, ValueError, KeyError, TypeError) as err:
        raise UserError(f"{folder} is not empty, and no folder of pairs; give a new one with --out.") from err
    if pairs is None:
        raise UserError(f"{folder} holds pairs of camera {whole['serial']}; give a new folder with --out.")
    print(f"{len(pairs)} pairs are there; going on")
    return pairs


def _fresh(camera: RealSense) -> Frame:
    """A picture that was taken after this was called."""
    called = time.monotonic()
    while time.monotonic() < called + WAIT_S:
        frame = camera.read()
        if frame is not None and frame.time > called:
            return frame
        time.sleep(0.01)
    raise PerceptionError(f"camera {camera.serial} sent no picture for {WAIT_S:.0f} s.")


def _save(path: Path, frame: Frame) -> None:
    cv2 = load("cv2")
    done, data = cv2.imencode(".png", cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
    assert done, path
    write_whole(path, data.tobytes())
