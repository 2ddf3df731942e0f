"""python -m envs.stand_in.server: the stand-in's own process; envs/stand_in/client.py starts and ends it.

Its first line of standard input is {"scene": MJCF of the task, "start_q": [7]}. After it, standard input is the leash:
when it closes, because the parent is done or was killed, this process ends. The first line of standard output says
where the robot and the scene are to be found. Everything listens on loopback addresses alone.

The scene's socket sends a line of JSON at CAMERA_HZ, {"time": s, "position": [x, y, z]}, as a camera would, and takes
the lines {"place": [x, y, z]}, {"fault": "reflex" | "user_stop" | null}, {"blind": bool} and {"silent": bool}.
"""

import json
import os
import select
import socket
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from envs.stand_in.scene import furnish

CAMERA_HZ = 50
TICK = 0.001  # [s] of the robot's controller
BEHIND = 0.1  # [s] that it may fall behind and catch up; more is let go
ANSWER = (
    0.1  # [s] to wait for a torque; meanwhile the arm's time stands still, so that a busy computer is not a bad robot
)


def patch_franky_sim() -> None:
    """Mend what franky-sim 1.0.4 does wrong, in this process alone.

    `BaseRobot.kinematics` returns a view of its buffer, so the measured pose becomes the desired one; its UDP sockets
    listen on every interface.
    """
    from franky_sim import base_simulator, franka_server

    shared_buffer = base_simulator.BaseRobot.kinematics
    base_simulator.BaseRobot.kinematics = lambda self, q: shared_buffer(self, q).copy()

    class Loopback(socket.socket):
        def bind(self, address: Any) -> None:
            super().bind(("127.0.0.1" if address[0] == "0.0.0.0" else address[0], *address[1:]))

    franka_server.socket = SimpleNamespace(**{**vars(socket), "socket": Loopback})


def wait_for_torque(robot: Any) -> None:
    """Wait for the answer to the state just sent, if the one before was answered; franky-sim itself never waits."""
    if robot.current_motion_id and robot._FrankaRobotServer__has_new_command:
        select.select([robot._FrankaServer__udp_socket], [], [], ANSWER)


class StandIn:
    """franky-sim with a task's scene, and a socket that shows and changes the scene.

    Args:
        scene: The nominal scene of the task that is to be rehearsed.
        start_q: Joint angles to begin with, [7] rad.
    """

    def __init__(self, scene: mujoco.MjModel, start_q: np.ndarray):
        patch_franky_sim()
        from franky_sim import SimulationServer
        from franky_sim.mujoco_simulator import MujocoSimulator

        self.sim = MujocoSimulator()
        self.sim.init()
        self.robot = self.sim.add_robot(initial_q=[float(x) for x in start_q])
        joint = furnish(self.sim.worldbody, scene)
        option = self.sim.scene.find("option")
        if option is not None:
            option.set("cone", "elliptic")
        self.server = SimulationServer(self.sim)
        self.server.init()
        assert self.sim.model is not None and self.sim.data is not None
        self.at = int(self.sim.model.joint(joint).qposadr[0])
        self.dof = int(self.sim.model.joint(joint).dofadr[0])
        self.door = socket.create_server(("127.0.0.1", 0))
        self.door.setblocking(False)
        self.viewers: list[tuple[socket.socket, bytearray]] = []
        self.blind = self.silent = False
        self.running = True

    def run(self) -> None:
        """Simulate in real time until `running` is false; time that cannot be made up is let go."""
        due, frames = time.monotonic(), 0
        every = round(1 / (CAMERA_HZ * TICK))
        robot = self.server.robot_servers[0]
        while self.running:
            if not self.silent:
                robot.process_commands()
                self.sim.step()
                robot.send_state()
                wait_for_torque(robot)
            frames += 1
            if frames % every == 0:
                self._serve()
            due += TICK
            now = time.monotonic()
            if now < due:
                time.sleep(due - now)
            elif now > due + BEHIND:
                due = now

    def _serve(self) -> None:
        """Let viewers in, do what they ask, show them the object."""
        try:
            viewer, _ = self.door.accept()
            viewer.setblocking(False)
            self.viewers.append((viewer, bytearray()))
        except BlockingIOError:
            pass
        data = self.sim.data
        assert data is not None
        frame = {"time": time.monotonic(), "position": data.qpos[self.at : self.at + 3].tolist()}
        line = (json.dumps(frame) + "\n").encode()
        for viewer, pending in list(self.viewers):
            try:
                while chunk := viewer.recv(4096):
                    pending += chunk
                raise ConnectionError  # an orderly end
            except BlockingIOError:
                pass
            except OSError:
                self.viewers.remove((viewer, pending))
                viewer.close()
                continue
            while b"\n" in pending:
                text, _, rest = bytes(pending).partition(b"\n")
                pending[:] = rest
                self._obey(json.loads(text))
            if not self.blind:
                try:
                    viewer.send(line)
                except OSError:
                    pass  # a viewer that does not look loses frames

    def _obey(self, order: dict[str, Any]) -> None:
        data = self.sim.data
        assert data is not None
        if "place" in order:
            data.qpos[self.at : self.at + 7] = [*order["place"], 1, 0, 0, 0]
            data.qvel[self.dof : self.dof + 6] = 0
        if "blind" in order:
            self.blind = bool(order["blind"])
        if "silent" in order:
            self.silent = bool(order["silent"])
        if "fault" in order:
            from envs.stand_in.faults import inject

            inject(self.server.robot_servers[0], order["fault"])


def main() -> None:
    """Read what to build, say where to connect, and simulate until standard input closes."""
    asked = json.loads(sys.stdin.readline())
    stand_in = StandIn(mujoco.MjModel.from_xml_string(asked["scene"]), np.array(asked["start_q"]))
    print(json.dumps({"robot": stand_in.robot.hostname, "scene": stand_in.door.getsockname()[1]}), flush=True)

    def leash() -> None:
        while os.read(0, 1024):
            pass
        stand_in.running = False

    threading.Thread(target=leash, daemon=True).start()
    stand_in.run()
    stand_in.server.cleanup()


if __name__ == "__main__":
    main()
