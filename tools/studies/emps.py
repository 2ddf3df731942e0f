"""The measured positioning drive EMPS: what diagnose says of it, how much error its answer leaves, how long it takes.

    python -m tools.studies.emps --data ../shared/data [--out results/emps/emps.csv]

Nominal is a mass on a slide with the motor's gain and nothing else; published are asymmetric viscous friction, Coulomb
friction and an offset. One row each: the whole library on the first half of DATA_EMPS, judged on the second half and on
DATA_EMPS_PULSES; its first two seconds alone; and the file against itself after the repair.
"""

import argparse
import csv
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.io import loadmat

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Episode
from mpc_sgft.diagnose.report import Report
from mpc_sgft.diagnose.run import run
from mpc_sgft.diagnose.simulation.plant import Plant

SCENE = """<mujoco><option timestep="0.001"/><worldbody><body name="carriage">
<joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="95"/></body></worldbody>
<actuator><motor name="motor" joint="x" gear="35.15"/></actuator></mujoco>"""
HALF = 12420  # samples, 12.42 s
SHORT = 2000


def read(folder: Path, name: str, part: slice, called: str) -> Episode:
    """One recording, or part of it: motor voltage [V] and measured position [m] at 1 kHz.

    Raises:
        UserError: If the file is not there.
    """
    path = folder / "emps" / f"{name}.mat"
    if not path.is_file():
        raise UserError(f"{path}: no such file. Give the folder that holds emps/ (--data).")
    data = loadmat(path)
    q = np.asarray(data["qm"], float).ravel()[part]
    return Episode(called, 0.001, np.asarray(data["vir"], float).reshape(-1, 1)[part], {"qpos/x": q})


def thirds(folder: Path) -> list[Episode]:
    """First half, second half, pulses."""
    return [
        read(folder, "DATA_EMPS", slice(0, HALF), "first"),
        read(folder, "DATA_EMPS", slice(HALF, None), "second"),
        read(folder, "DATA_EMPS_PULSES", slice(None), "pulses"),
    ]


def verdict(episodes: list[Episode], spec: mujoco.MjSpec | None = None, **options: Any) -> Report:
    """What diagnose says of some recordings; options as of `mpc_sgft.diagnose.diagnose`."""
    given = {"out": None, "effects": None, "signals": None, "window": None, "held_out": None, "seed": 0}
    given |= {
        "uncertain": {"mass": 0.3},
        "max_effects": 3,
        "tolerance": None,
        "traces": False,
        "progress": False,
    } | options
    return run(Plant(spec or mujoco.MjSpec.from_string(SCENE)), episodes, **given)


def whole(folder: Path, out: Path | None = None) -> Report:
    """Fitted on the first half in windows of 0.5 s, the second half and the pulses held out."""
    return verdict(thirds(folder), held_out=["second", "pulses"], window=0.5, out=out)


def errors(report: Report) -> dict[str, float]:
    """Root mean square error of the repaired model on each recording [mm]."""
    w, missed = report.replayer.windows, report.repaired - report.measured
    names = [e.name for e in report.replayer.episodes]
    return {n: 1e3 * float(np.sqrt((missed[w.episode == i] ** 2).mean())) for i, n in enumerate(names)}


def split_after_repair(folder: Path, out: Path, repaired: Path) -> Report:
    """The first half against the second, with the repaired scene as the nominal one."""
    spec = mujoco.MjSpec.from_file(str(repaired))
    return verdict(thirds(folder)[:2], spec, held_out=["second"], uncertain={"mass": 0.05}, out=out)


def row(what: str, report: Report) -> dict[str, Any]:
    d = report.as_dict()
    values = {k: v for e in d["effects"] for k, v in ((f"{e['name']}.{p}", x) for p, x in e["parameters"].items())}
    left = errors(report)
    return {
        "what": what,
        "verdict": d["verdict"],
        "effects": " ".join(e["name"] for e in d["effects"]),
        "ties": " | ".join("+".join(t["effects"]) for t in d["ties"]),
        "parameters": " ".join(f"{k}={v['value']:.4g}[{v['low']:.4g},{v['high']:.4g}]" for k, v in values.items()),
        **{f"{name}_mm": round(left[name], 4) if name in left else "" for name in ("first", "second", "pulses")},
        "seconds": d["seconds"],
        "cores": os.cpu_count(),
    }


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder that holds emps/")
    parser.add_argument("--out", type=Path, default=Path("results/emps/emps.csv"), help="default results/emps/emps.csv")
    args = parser.parse_args(argv)
    rows = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(row("whole library", whole(args.data, Path(folder))))
            print(rows[-1], flush=True)
            rows.append(row("first 2 s", verdict([read(args.data, "DATA_EMPS", slice(0, SHORT), "first")])))
            print(rows[-1], flush=True)
            again = split_after_repair(args.data, Path(folder) / "again", Path(folder) / "repaired.xml")
            rows.append(row("against itself after the repair", again))
            print(rows[-1], flush=True)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
