"""How long diagnose takes, by seconds of data and by candidates, and on a deployment.

    python -m tools.benchmarks.time_diagnose [--out results/timing/time_diagnose.csv] [--run runs/push/latest] [--quick]
                                             [--case CASE...]

A pendulum with hidden friction is simulated finely and diagnosed, with 4 to 32 s of data and the whole library but for
contacts, and with 8 s of data and part of the library. `per` is the time by the seconds of data, or by the candidates,
relative to the smallest row of the same kind, measured in the same process: 1 means that the cost is proportional,
less that it grows slower. A case is a folder with model.xml and episodes, such as one of the FR3 that
`tools.studies.blind_benchmark --fr3 1 --only generate` makes.
"""

import argparse
import csv
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from envs.effects import load
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.candidates.effect_facts import effect_class
from mpc_sgft.diagnose.candidates.effect_table import TABLE
from mpc_sgft.diagnose.data.measured import write_csv
from mpc_sgft.diagnose.deployed import diagnose_run
from mpc_sgft.diagnose.run import read
from mpc_sgft.diagnose.simulation.plant import load_plant

PENDULUM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="hinge" axis="0 1 0" damping="0.02"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="0.6"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
HIDDEN = {"viscous_friction": {"coefficient": 0.05}}
NOISE = 1e-4  # [rad]
FINE = 10  # steps of the hidden machine in one sample
NAMES = [name for name in TABLE if effect_class(name).place != "geom"]  # nothing touches a pendulum
PARTS = (5, 10, len(NAMES))
DURATIONS = (4.0, 8.0, 16.0, 32.0)  # [s]


def record(folder: Path, seconds: float) -> list[Path]:
    """Two episodes of the pendulum with the hidden effect; their files."""
    spec = mujoco.MjSpec.from_string(PENDULUM)
    for effect in load(HIDDEN):
        effect.edit_spec(spec)
    model, files, sample = spec.compile(), [], spec.option.timestep
    model.opt.integrator, model.opt.timestep = int(mujoco.mjtIntegrator.mjINT_RK4), sample / FINE
    for episode in range(2):
        rng, data = np.random.default_rng(episode), mujoco.MjData(model)
        t = np.arange(round(seconds / 2 / sample)) * sample
        u = sum(0.6 / k * np.sin(2 * np.pi * 0.7 * k * t + rng.uniform(0, 6.3)) for k in (1, 2, 3))
        q = np.empty(len(t))
        for i, command in enumerate(u):
            q[i], data.ctrl[0] = data.qpos[0], command
            mujoco.mj_step(model, data, FINE)
        files.append(folder / f"{seconds:g}_{episode}.csv")
        write_csv(files[-1], {"time": t, "ctrl/motor": u, "qpos/hinge": q + NOISE * rng.standard_normal(len(t))})
    return files


def measure(folder: Path, seconds: float, names: list[str], kind: str) -> dict[str, Any]:
    """One row."""
    began, busy = time.perf_counter(), time.process_time()
    report = diagnose(mujoco.MjSpec.from_string(PENDULUM), record(folder, seconds), effects=names).as_dict()
    return {
        "what": kind,
        "seconds_of_data": seconds,
        "names": len(names),
        "said": " ".join([report["verdict"], *(e["name"] for e in report["effects"])]),
        "wall_s": round(time.perf_counter() - began, 1),
        "cpu_s": round(time.process_time() - busy, 1),
    }


def measure_case(case: Path) -> dict[str, Any]:
    """One row of a folder with a model and episodes."""
    began, busy, files = time.perf_counter(), time.process_time(), sorted(case.glob("*.csv"))
    report = diagnose(case / "model.xml", files).as_dict()
    joints = mujoco.MjModel.from_xml_path(str(case / "model.xml")).njnt
    return {
        "what": f"{joints} joints",
        "seconds_of_data": round(float(sum(e.seconds for e in read(load_plant(case / "model.xml"), files)[1])), 1),
        "said": " ".join([report["verdict"], *(e["name"] for e in report["effects"])]),
        "wall_s": round(time.perf_counter() - began, 1),
        "cpu_s": round(time.process_time() - busy, 1),
    }


def measure_run(run: Path) -> dict[str, Any]:
    """One row of a deployment."""
    began, busy = time.perf_counter(), time.process_time()
    report = diagnose_run(run).as_dict()
    return {
        "what": f"deployment of {len(list((run / 'episodes').glob('*.mcap')))} episodes",
        "said": " ".join([report["verdict"], *(e["name"] for e in report["effects"])]),
        "wall_s": round(time.perf_counter() - began, 1),
        "cpu_s": round(time.process_time() - busy, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/timing/time_diagnose.csv"))
    parser.add_argument("--run", type=Path, help="run folder of a deployment")
    parser.add_argument("--case", type=Path, nargs="+", default=[], help="folders with model.xml and episodes")
    parser.add_argument("--quick", action="store_true", help="the smallest of each only")
    args = parser.parse_args()
    durations, parts = (DURATIONS[:1], PARTS[:1]) if args.quick else (DURATIONS, PARTS)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seconds in durations:
            rows.append(measure(Path(folder), seconds, NAMES, "data"))
            rows[-1]["per"] = round(rows[-1]["cpu_s"] / rows[0]["cpu_s"] * durations[0] / seconds, 2)
            print(rows[-1], flush=True)
        first = len(rows)
        for count in parts:
            rows.append(measure(Path(folder), 8.0, NAMES[:count], "candidates"))
            rows[-1]["per"] = round(rows[-1]["cpu_s"] / rows[first]["cpu_s"] * parts[0] / count, 2)
            print(rows[-1], flush=True)
    for case in args.case:
        rows.append(measure_case(case))
        print(rows[-1], flush=True)
    if args.run:
        rows.append(measure_run(args.run))
        print(rows[-1], flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], "cores"], lineterminator="\n")
        writer.writeheader()
        writer.writerows([row | {"cores": os.cpu_count()} for row in rows])


if __name__ == "__main__":
    main()
