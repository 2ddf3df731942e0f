"""Find where simulation and measurement disagree, name the missing effect, repair the model.

    from mpc_sgft.diagnose import diagnose
    report = diagnose("scene.xml", ["episodes/"], out=Path("out"))
    report = diagnose_run(Path("runs/push/latest"))  # from mpc_sgft.diagnose.deployed: what deploy recorded

`run` goes the whole way from files to a report, `deployed` from a deployment's run folder. Each room builds on those
before it: `data` (read, map, check, smooth, cut), `simulation` (the nominal model over measured windows), `candidates`
(what may be missing), `fitting` (how well a set of effects explains the data), `verdict` (its name, whether it matters,
where it shows, the repair), `page` (report.html), `deployments` (a task's actions and observations in place of joint
signals). `inspect` says what is in recordings before anything runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

    from mpc_sgft.diagnose.data.mapping import Source
    from mpc_sgft.diagnose.report import Report

__all__ = ["diagnose"]


def diagnose(
    model: str | Path | mujoco.MjModel | mujoco.MjSpec,
    data: Sequence[str | Path],
    *,
    out: Path | None = None,
    effects: Sequence[str] | None = None,
    signals: Sequence[str] | None = None,
    window: float | None = None,
    held_out: float | Sequence[str] | None = None,
    uncertain: Mapping[str, float] | None = None,
    seed: int = 0,
    max_effects: int = 3,
    tolerance: float | Mapping[str, float | str] | None = None,
    traces: bool = False,
    mapping: Mapping[str, str | Source] | None = None,
    progress: bool = False,
) -> Report:
    """Compare a model with measurements and say what it lacks.

    Args:
        model: MJCF or URDF file, spec, or the model that was compiled last. A URDF has no actuators: joints whose
            efforts were recorded as `ctrl/<joint>` get motors.
        data: Episode files (CSV, Parquet, MCAP), ROS 2 bags, LeRobotDataset folders, and folders of these.
        out: Folder for report.json, report.html, report.rrd, and where the error on windows that were never fitted
            credibly falls, repaired.xml and effects.yaml; nothing is written if None.
        effects: Names of the only effects to consider; all that the data can show if None.
        signals: Compared columns, such as `qpos/elbow`; all positions and measured forces if None.
        window: Length of a simulated window [s]; chosen from the data if None.
        held_out: Share of the data that is never fitted, or names of episodes; a quarter if None.
        uncertain: Nominal quantities (mass, gain, length, inertia, armature, damping) -> share by which they may be
            wrong. They are refitted in the baseline and in every candidate.
        seed: Of the bootstrap and the residual model.
        max_effects: Largest set of effects.
        tolerance: Prediction error that does not matter: a share of each signal's standard deviation, or signal ->
            number in its unit or with a unit of its own ("0.5mm"), and then other signals do not count. If None,
            an effect matters that takes away a hundredth of the squared error, or moves a signal by one of its motion.
        traces: Whether repaired.xml and effects.yaml hold effects that are there and do not matter, too.
        mapping: Our column -> what it is made of, {"qpos/elbow": "-1*encoder deg + 0.1"}, where files name or measure
            things otherwise.
        progress: Show a progress bar on stderr.

    Raises:
        UserError: For data or a model that cannot be used; the message says what came and what to do.
    """
    from mpc_sgft.diagnose.data.mapping import parse_mapping
    from mpc_sgft.diagnose.run import read, run
    from mpc_sgft.diagnose.simulation.plant import load_plant

    plant, recorded = read(load_plant(model), data, parse_mapping(mapping or {}))
    return run(
        plant,
        recorded,
        out=out,
        effects=effects,
        signals=signals,
        window=window,
        held_out=held_out,
        uncertain=uncertain or {},
        seed=seed,
        max_effects=max_effects,
        tolerance=tolerance,
        traces=traces,
        progress=progress,
    )
