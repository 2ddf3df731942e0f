"""The repaired model as plain MJCF, and the effects as yaml for `pretrain` and `deploy`."""

from __future__ import annotations

from collections.abc import Callable
from difflib import unified_diff
from pathlib import Path
from typing import Any

import mujoco

from envs.effects.base import Effect, load
from mpc_sgft.diagnose.candidates.library import as_gap, settings
from mpc_sgft.diagnose.candidates.nominal import scale
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.simulation.plant import FORCE, Plant
from mpc_sgft.diagnose.verdict.relevance import Repairs


def diff(nominal: mujoco.MjSpec, repaired: Path) -> str:
    """What a repaired scene changes, as a unified diff of MJCF."""
    nominal.compile()
    before, after = nominal.to_xml().splitlines(), repaired.read_text().splitlines()
    return "\n".join(unified_diff(before, after, fromfile="nominal", tofile="repaired", n=2, lineterm=""))


def nominal_spec(plant: Plant) -> mujoco.MjSpec:
    """The scene as it was given."""
    spec = plant.spec.copy()
    for sensor in list(spec.sensors):
        if sensor.name.startswith(FORCE):
            spec.delete(sensor)
    for actuator in spec.actuators:
        actuator.nsample = plant.histories.get(actuator.name, actuator.nsample)
    return spec


def repaired_spec(plant: Plant, best: Hypothesis) -> tuple[mujoco.MjSpec, list[str]]:
    """The scene with refitted quantities and effects in it, and what MJCF cannot carry, in words."""
    spec, notes = nominal_spec(plant), []
    for term, value in zip(best.fit.terms, best.fit.values, strict=True):
        if term.effect == "nominal":
            scale(spec, plant, term.names[0], term.at[0], float(value[0]))
            continue
        effect = load({term.effect: settings(term, value)})[0]
        if type(effect).edit_spec is not Effect.edit_spec:
            effect.edit_spec(spec)
        if not type(effect).native:
            notes.append(f"{term.label}: MJCF has no field for it; use effects.yaml")
    return spec, notes


FILES = ("repaired.xml", "effects.yaml")


def into(
    out: Path,
    data: dict[str, Any],
    held: Hypothesis,
    repairs: Repairs,
    write_files: Callable[[], list[str]],
    unstable: str = "",
) -> None:
    """Write the repair into a folder if it repairs, and say so in the report: those of an earlier report go.

    Args:
        out: The folder.
        data: Of the report.
        held: What the repair holds.
        repairs: Whether it credibly lowers errors.
        write_files: Writes repaired.xml and effects.yaml, and returns notes; a ValueError says that what it wrote does
            not load.
        unstable: Why the scene cannot be simulated with it, if it cannot.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        (out / name).unlink(missing_ok=True)
    if not held.fit.terms:
        return
    what, h = " + ".join(held.names) or "refitted quantities", data["held_out"]
    if unstable:
        data["notes"].append(f"no repaired.xml: {unstable}")
        return
    if not repairs.lowers:
        data["notes"].append(
            f"no repaired.xml: with {what}, errors on {repairs.on} do not credibly fall "
            f"(never fitted, {h['signal']}: {h['nominal']:.3g} -> {h['repaired']:.3g} {h['unit']}). "
            "More episodes tell more"
        )
        return
    try:
        notes = write_files()
    except ValueError as error:
        for name in FILES:
            (out / name).unlink(missing_ok=True)
        data["notes"].append(
            f"no repaired.xml: the scene with {what} in it does not load from there ({' '.join(str(error).split())}). "
            "Give the files of the scene by absolute names, and diagnose again"
        )
        return
    data["repaired_model"], data["effects_file"] = FILES
    data["notes"] += [f"repaired.xml: errors credibly fall on {repairs.on}", *notes]
    if data["verdict"] == "unknown":
        data["notes"].append(
            f"repaired.xml and effects.yaml hold {what}: a fit that takes part of the error away, not its name"
        )


def write(plant: Plant, best: Hypothesis, out: Path) -> list[str]:
    """Write repaired.xml and effects.yaml; returns notes.

    Raises:
        ValueError: If the written scene does not load.
    """
    import yaml

    spec, notes = repaired_spec(plant, best)
    spec.compile()
    path = out / "repaired.xml"
    path.write_text(spec.to_xml())
    mujoco.MjModel.from_xml_path(str(path))
    mapping = as_gap((t.effect, settings(t, v)) for t, v in zip(best.terms, best.values, strict=True))
    refit = {
        f"{t.names[0]} {t.at[0]}": round(float(v[0]), 6)
        for t, v in zip(best.fit.terms, best.fit.values, strict=True)
        if t.effect == "nominal"
    }
    head = "# Written by mpc_sgft.diagnose.\n"
    if refit:
        head += f"# Refitted nominal quantities (factors, in repaired.xml only): {refit}\n"
    (out / "effects.yaml").write_text(head + yaml.safe_dump({"effects": mapping}, sort_keys=False))
    return notes
