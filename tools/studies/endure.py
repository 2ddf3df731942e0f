"""Many resets and control steps in a row on the robot's backend: how often does one fail?

    python -m tools.studies.endure --resets 100 --steps 1000 --out results/endure/endure.json
    python -m tools.studies.endure --robot-ip IP --set perception=fixed      # a robot; docs/robot.md comes first

The steps are shared out among the resets; actions are drawn anew in each step, from the whole range times --size. An
abort is a step that the backend ended, or a reset that did not arrive; the next reset recovers, as in a session.
On the stand-in, periods are counted on its own clock and the watchdogs are generous, so that a busy computer makes this
slow and not wrong. Ends with exit code 1 if there was an abort, 2 if the robot cannot be used.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from envs.backends.base import BackendError
from envs.backends.clock import make_clock
from envs.backends.franka import FrankaBackend
from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import robot
from mpc_sgft.session.operator import Nobody
from mpc_sgft.storage.metrics import progress
from mpc_sgft.storage.run_folder import versions
from mpc_sgft.storage.whole_file import write_whole

PATIENT = ("backend.limits.state_age=5", "backend.limits.detection_age=5", "backend.patience=5")
GIVE_UP = 3  # resets in a row that do not arrive


def endure(backend: FrankaBackend, resets: int, steps: int, *, size: float, seed: int) -> dict[str, object]:
    """Reset and step; what happened, of which `aborts` are the failures, each with its reset, step and reason."""
    rng, lost = np.random.default_rng(seed), 0
    done = {"resets": 0, "steps": 0}
    aborts: list[dict[str, object]] = []
    bar = progress(resets, desc="endure", unit="reset")
    for number in range(1, resets + 1):
        try:
            backend.reset(np.arange(1))
        except BackendError as error:
            aborts.append({"reset": number, "step": 0, "why": str(error)})
            backend.fault = backend.fault or str(error)  # the next reset recovers from it
            lost += 1
            if lost == GIVE_UP:
                break
            continue
        lost = 0
        done["resets"] += 1
        for step in range(1, steps * number // resets - steps * (number - 1) // resets + 1):
            action = size * rng.uniform(-1, 1, (1, backend.task.action_dim))
            if backend.send(action).invalid[0]:
                aborts.append({"reset": number, "step": step, "why": backend.note})
                break
            done["steps"] += 1
        else:
            backend.rig.retries.succeeded()  # only aborts in a row end a session
        backend.samples()  # let go of the record
        bar.update(1)
        bar.set_postfix(steps=done["steps"], aborts=len(aborts))
    bar.close()
    return {**done, "aborts": aborts}


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot-ip", default=robot.STAND_IN, help="address, or stand-in (default)")
    parser.add_argument(
        "--clock", choices=["wall", "robot"], help="of the periods: robot for a simulated controller that is slow"
    )
    parser.add_argument("--resets", type=int, default=100, help="how many (default 100)")
    parser.add_argument("--steps", type=int, default=1000, help="control steps, in all (default 1000)")
    parser.add_argument("--size", type=float, default=0.5, help="share of the action's range (default 0.5)")
    parser.add_argument("--seed", type=int, default=0, help="of starts and actions")
    parser.add_argument("--set", nargs="*", default=[], metavar="name=value", help="overrides, as deploy takes them")
    parser.add_argument("--out", type=Path, default=Path("results/endure/endure.json"), help="JSON to write")
    args = parser.parse_args(argv)
    patient = PATIENT if args.robot_ip == robot.STAND_IN else ()
    given = ["backend=franka", f"robot-ip={args.robot_ip}", *patient, *args.set]
    try:
        if not (args.resets > 0 <= args.steps and 0 < args.size <= 1):
            raise UserError("--resets must be above 0, --steps 0 or more, --size above 0 and at most 1.")
        overrides = [compose.normalise(text) for text in given]
        compose.check("deploy", overrides, sweep=False)
        env = robot.make_env(compose.compose("deploy", overrides, given))
        backend = env.backend
        assert isinstance(backend, FrankaBackend)
        if args.clock:
            backend.rig.clock = make_clock(args.clock, backend.rig.arm)
        longest = -(-args.steps // args.resets)
        if longest > backend.task.episode_steps:
            raise UserError(
                f"{longest} steps after a reset; an episode has {backend.task.episode_steps}. More --resets."
            )
        began = time.monotonic()
        try:
            robot.connect(env, Nobody())
            backend.seed(args.seed)
            found = endure(backend, args.resets, args.steps, size=args.size, seed=args.seed)
        finally:
            backend.close()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    asked = {"resets_asked": args.resets, "steps_asked": args.steps, "size": args.size, "seed": args.seed}
    machine = {"seconds": round(time.monotonic() - began, 1), "versions": versions()}
    summary = {
        "robot_ip": args.robot_ip,
        "clock": args.clock,
        "overrides": given,
        **asked,
        **found,
        **backend.report(),
        **machine,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(args.out, (json.dumps(summary, indent=2) + "\n").encode())
    aborts = found["aborts"]
    assert isinstance(aborts, list)
    print(f"{found['resets']} resets, {found['steps']} steps, {len(aborts)} aborts; written to {args.out}")
    return int(bool(aborts) or found["resets"] != args.resets or found["steps"] != args.steps)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
