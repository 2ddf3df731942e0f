"""Cases of a foreign engine on disk, and what their labels say; in the folders of blind/cases."""

from pathlib import Path
from typing import Any

from tools.studies.blind.cases import instead, put, seal
from tools.studies.blind.library import place
from tools.studies.foreign.make import Made
from tools.studies.foreign.scenes import SCENES


def write(out: Path, made: list[Made], seed: int, tolerance: float) -> str:
    """Write folders and labels; the labels' hash.

    Args:
        out: The ground's folder.
        made: All cases.
        seed: They came from.
        tolerance: What the user tolerates, as a share of the motion.
    """
    for one in made:
        known = {"uncertain": one.case.uncertain, "tolerance": tolerance}
        put(out / "cases" / one.case.name, one.model, known, one.episodes)
    return seal(out, {"seed": seed, "cases": {one.case.name: label(one) for one in made}})


def label(made: Made) -> dict[str, Any]:
    """All that is hidden about a case, and what scores are split by."""
    case, scene = made.case, SCENES[made.case.scene]
    return {
        "group": case.group,
        "kind": "swings" if case.swings else "",
        "plant": case.scene,
        "seconds": sum(case.seconds),
        "dt": case.dt,
        "noise_level": case.noise,
        "speed_channel": case.speed_channel,
        "force_channel": case.force_channel,
        "effects": [{**t, "at": place(scene, t["name"], t["joint"])} for t in made.truth],
        "equivalents": instead([(t["name"], t["equal"]) for t in made.truth]),
        "alike": instead([(t["name"], t["alike"]) for t in made.truth]),
        **made.more,
    }
