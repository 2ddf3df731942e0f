"""Which names exist, read from the folders: a file is a registration. Light, so that --help answers at once."""

from __future__ import annotations

from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
CONFIG_DIR = ROOT / "configs"
EFFECT_DIR = ROOT / "envs" / "effects"
WORDS = {  # settings beside the groups that take one of a few words
    "device": ("auto", "cpu", "cuda"),
    "physics": ("mujoco", "warp"),
    "policy": ("planner", "zero", "random", "scripted"),
    "success": ("task", "ask"),
}


def groups() -> dict[str, list[str]]:
    """Config groups and their options, {folder of configs/: sorted file names without .yaml}."""
    folders = sorted(path for path in CONFIG_DIR.iterdir() if path.is_dir() and not path.name.startswith(("_", ".")))
    return {folder.name: sorted(path.stem for path in folder.glob("*.yaml")) for folder in folders}


def groups_of(command: str) -> dict[str, list[str]]:
    """The groups that one command has, in the order of its defaults list, and `experiment`; each with its options."""
    defaults = yaml.safe_load((CONFIG_DIR / f"{command}.yaml").read_text())["defaults"]
    names = [name for entry in defaults if isinstance(entry, dict) for name in entry] + ["experiment"]
    found = groups()
    return {name: found.get(name, []) for name in names}


def effects() -> list[str]:
    """Names of the effects in envs/effects/, sorted."""
    shared = ("base", "passive", "rotor")  # what the effects are made of
    return sorted(p.stem for p in EFFECT_DIR.glob("*.py") if not p.stem.startswith("_") and p.stem not in shared)
