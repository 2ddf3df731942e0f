"""The robot's backend against franka-sim, which enforces motion limits and communication constraints as the robot does.

    python -m tools.studies.nightly_franka_sim --steps 200 --out results/franka_sim/franka_sim.json

franka-sim's pins clash with this project's, so it gets an environment of its own (--env, made once). It serves the FR3
of envs/fr3.py on a loopback address, without a table; the object stands still (perception=fixed): what is measured is
the arm's motion. `tools.studies.endure` does the resets and steps; a command or a motion that the controller does not
allow ends the motion and counts as an abort. Periods are counted on franka-sim's clock: where it cannot keep up with
real time, targets in real time would be too fast for its arm. Exit codes are those of tools.studies.endure.
"""

import argparse
import json
import shutil
import socket
import subprocess
import sys
import time
import venv
from pathlib import Path

import mujoco
import numpy as np
from hydra.utils import instantiate

from envs.fr3 import add_fr3
from envs.tasks.push import TOOL_LENGTH, TOOL_RADIUS
from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.whole_file import write_whole
from tools.studies import endure

PACKAGE, PORT = "franka-sim==1.1.7", 1337
HOST = "127.90.0.1"  # of its own: the project's stand-in takes the first free addresses from 127.0.0.1 on
START = 60.0  # [s] for the server to listen
SERVER = (
    "import json, logging, sys; import numpy as np; logging.basicConfig(level='INFO');"
    "from franka_sim import FrankaSimServer as Server, mujoco_franka_sim as sim;"
    "sim.ARM_INITIAL_Q = np.array(json.loads(sys.argv[1]));"
    f"Server(host='{HOST}', port={PORT}, enable_gripper=False,"
    " enforce_comm_constraints=True, enforce_motion_limits=True).start()"
)
VIOLATION = "violation"  # in its log


def environment(folder: Path) -> Path:
    """The Python that has franka-sim; made if it is not there.

    Raises:
        UserError: If it cannot be installed.
    """
    python = folder / "bin" / "python"
    ready = folder / PACKAGE
    if ready.exists():
        return python
    shutil.rmtree(folder, ignore_errors=True)
    print(f"installing {PACKAGE} into {folder}", flush=True)
    venv.create(folder, with_pip=True)
    line = [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check", PACKAGE]
    if subprocess.run(line).returncode:
        raise UserError(f"{PACKAGE} could not be installed into {folder}; pip's own words are above.")
    ready.touch()
    return python


def arm_alone() -> str:
    """MJCF of the FR3 as franka-sim's older MuJoCo reads it, without motors, which the server has itself.

    It touches nothing: the table of the task lies below franka-sim's floor.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_fr3(spec, base=(0, 0, 0), tool_length=TOOL_LENGTH, tool_radius=TOOL_RADIUS)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    spec.compile()
    return spec.to_xml()


def start_posture() -> list[float]:
    """Joint angles [7] rad from which the way to a start is allowed, as a person would have guided the arm."""
    task = compose.compose("deploy", ["task=push"], []).task
    push = instantiate({**task.env, **task.on_robot}, _convert_="all")
    return push.start(np.random.default_rng(0)).qpos[0, :7].tolist()


def start(python: Path, folder: Path) -> subprocess.Popen:
    """A running server; its words go into server.log.

    Raises:
        UserError: If it does not come up, or something else is at its address.
    """
    if listens():
        raise UserError(f"something listens at {HOST}:{PORT} already; end it first.")
    (folder / "fr3.xml").write_text(arm_alone())
    log = (folder / "server.log").open("w")
    process = subprocess.Popen(
        [str(python), "-c", SERVER, json.dumps(start_posture())],
        stdout=log,
        stderr=log,
        env={"FR3_MJCF": str(folder / "fr3.xml")},
    )
    deadline = time.monotonic() + START
    while time.monotonic() < deadline and process.poll() is None:
        if listens():
            return process
        time.sleep(0.2)
    stop(process)
    last = (folder / "server.log").read_text().strip().splitlines()[-1:] or ["it said nothing"]
    raise UserError(f"franka-sim did not start: {last[0]}")


def listens() -> bool:
    """Whether anybody takes connections at the server's address."""
    with socket.socket() as probe:
        return probe.connect_ex((HOST, PORT)) == 0


def stop(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cache = Path.home() / ".cache" / "mpc_sgft" / "franka-sim"
    parser.add_argument("--env", type=Path, default=cache, help=f"environment of franka-sim (default {cache})")
    parser.add_argument("--resets", type=int, default=10, help="how many (default 10)")
    parser.add_argument("--steps", type=int, default=200, help="control steps, in all (default 200)")
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides, as deploy takes them")
    parser.add_argument("--out", type=Path, default=Path("results/franka_sim/franka_sim.json"), help="JSON to write")
    args = parser.parse_args(argv)
    folder = args.out.with_suffix("")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        process = start(environment(args.env.resolve()), folder.resolve())
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        words = ["--robot-ip", HOST, "--resets", str(args.resets), "--steps", str(args.steps), "--out", str(args.out)]
        settings = ["perception=fixed", *endure.PATIENT, *args.set]
        code = endure.main([*words, "--clock", "robot", "--set", *settings])
    finally:
        stop(process)
    if args.out.exists():
        said = [line for line in (folder / "server.log").read_text().splitlines() if VIOLATION in line]
        found = {**json.loads(args.out.read_text()), "controller": PACKAGE, "violations": said[:20]}
        write_whole(args.out, (json.dumps(found, indent=2) + "\n").encode())
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
