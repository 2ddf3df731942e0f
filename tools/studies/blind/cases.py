"""Cases on disk: a folder each for the solver, the labels apart from them, and the labels' hash.

DIR/cases/<name>/   model.xml  episode_<n>.csv  known.json (what the user knows: uncertain quantities)
DIR/labels.json     what is hidden, by case; nothing that runs the solver opens it
DIR/labels.sha256   its hash, printed before the solver starts
DIR/reports/<name>/ what the solver wrote
"""

import hashlib
import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from tools.studies.blind import fr3
from tools.studies.blind.library import equivalents, place
from tools.studies.blind.made import Made
from tools.studies.blind.mjcf import build
from tools.studies.blind.plants import PLANTS, Array

DIGITS = 5  # of numbers in labels


def write(out: Path, made: list[Made], seed: int, tolerance: float = 0.0) -> str:
    """Write folders and labels.

    Args:
        out: The benchmark's folder; made if it is not there.
        made: All cases.
        seed: They came from.
        tolerance: What the user tolerates, as a share of the motion; 0 if nobody says.

    Returns:
        SHA-256 of labels.json.
    """
    for one in made:
        text = fr3.build() if one.case.plant == "fr3" else build(PLANTS[one.case.plant], one.case.nominal)
        known = {"uncertain": one.case.uncertain} | ({"tolerance": tolerance} if tolerance else {})
        put(out / "cases" / one.case.name, text, known, one.episodes)
    return seal(out, {"seed": seed, "cases": {one.case.name: label(one) for one in made}})


def put(folder: Path, model: str, known: dict[str, Any], episodes: list[dict[str, Array]]) -> None:
    """One case as the solver gets it: the nominal MJCF, what the user knows, and a file for each episode."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(model)
    (folder / "known.json").write_text(json.dumps(known))
    for i, columns in enumerate(episodes):
        table = np.column_stack(list(columns.values()))
        with (folder / f"episode_{i}.csv").open("w") as file:
            np.savetxt(file, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")


def seal(out: Path, hidden: dict[str, Any]) -> str:
    """Write labels and their hash, which is the same on processors that round the simulations differently."""
    text = json.dumps(_rounded(hidden), indent=1)
    (out / "labels.json").write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    (out / "labels.sha256").write_text(digest + "\n")
    return digest


def _rounded(x: Any) -> Any:
    """The same with numbers of DIGITS digits."""
    if isinstance(x, float):
        return float(f"{x:.{DIGITS}g}")
    if isinstance(x, dict):
        return {k: _rounded(v) for k, v in x.items()}
    return [_rounded(v) for v in x] if isinstance(x, list | tuple) else x


def label(made: Made) -> dict[str, Any]:
    """All that is hidden about a case, and what scores are split by."""
    case = made.case
    plant = fr3.Arm() if case.plant == "fr3" else PLANTS[case.plant]
    where = {t["name"]: t["joint"] for t in made.truth}
    effects = [{**t, "at": place(plant, t["name"], t["joint"])} for t in made.truth]
    return {
        "group": case.group,
        "kind": case.kind,
        "plant": case.plant,
        "seconds": case.seconds,
        "noise_level": case.noise,
        "noise_floor": made.floor,
        "jitter": case.jitter,
        "speed_channel": case.speed_channel,
        "force_channel": case.force_channel,
        "wrong_nominal": case.wrong,
        "effects": effects,
        "equivalents": equivalents(case.plant, where, case.force_channel),
        "alike": instead([(t["name"], t["alike"]) for t in made.truth]),
        **made.more,
    }


def instead(effects: list[tuple[str, list[str]]]) -> list[list[str]]:
    """Sets of names that these data cannot tell from the hidden set: some replaced by names alike (see alike)."""
    own = sorted(name for name, _ in effects)
    sets = {tuple(sorted(names)) for names in product(*([name, *others] for name, others in effects))}
    return [list(names) for names in sorted(sets) if list(names) != own and len(set(names)) == len(names)]


def labels(out: Path) -> dict[str, dict[str, Any]]:
    """Labels by case name, if they are still those whose hash was printed.

    Raises:
        ValueError: If there are none, or they were changed since.
    """
    path = out / "labels.json"
    if not path.is_file():
        raise ValueError(f"{out} holds no cases yet; run with --only generate first")
    text = path.read_text()
    if hashlib.sha256(text.encode()).hexdigest() != (out / "labels.sha256").read_text().strip():
        raise ValueError(f"{path} is not what was generated: its hash differs from labels.sha256. Generate anew.")
    return json.loads(text)["cases"]


def label_hashes(out: Path) -> dict[str, str]:
    """SHA-256 of each case's own label, by case name: of a label that is alike on two processors, alike."""
    return {name: hashlib.sha256(json.dumps(x).encode()).hexdigest()[:16] for name, x in labels(out).items()}


def sealed(out: Path, seed: int) -> str:
    """The hash of the labels, if they are of this seed and still those whose hash was printed.

    Raises:
        ValueError: If they are not.
    """
    labels(out)
    if seed_of(out) != seed:
        raise ValueError(f"{out} holds cases of seed {seed_of(out)}, not of {seed}")
    return (out / "labels.sha256").read_text().strip()


def seed_of(out: Path) -> int:
    """The seed that a folder was generated from."""
    return int(json.loads((out / "labels.json").read_text())["seed"])
