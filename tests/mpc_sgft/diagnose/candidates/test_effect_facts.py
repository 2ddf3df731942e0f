"""A new file in envs/effects/ is all that a new effect takes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import envs.effects
from envs.effects.base import available
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.candidates.effect_facts import facts_of, possible, size_from_unit
from mpc_sgft.diagnose.candidates.effect_table import TABLE, TypicalSizes

CUBIC = '''"""A joint resists with the cube of its speed."""
from dataclasses import dataclass
from typing import ClassVar
import mujoco
from envs.effects.base import Effect
from envs.effects.passive import scalar_joints

@dataclass(frozen=True)
class CubicDrag(Effect):
    coefficient: float = 0.0
    at: tuple[str, ...] = ()
    place: ClassVar[str] = "joint"
    units: ClassVar[dict[str, str]] = {"coefficient": "N m s^3/rad^3 or N s^3/m^3"}
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 1e5)}

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for joint in scalar_joints(spec, self.at):
            joint.damping[2] += self.coefficient

EFFECT = CubicDrag
'''


@pytest.fixture
def cubic_drag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """envs/effects/ with one file more."""
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "cubic_drag.py").write_text(CUBIC)
    monkeypatch.setattr(envs.effects, "__path__", [*envs.effects.__path__, str(tmp_path / "more")])
    available.cache_clear()
    importlib.invalidate_caches()
    yield
    sys.modules.pop("envs.effects.cubic_drag", None)
    available.cache_clear()


def test_a_new_file_is_looked_for_and_named(cubic_drag: None, slide: Path, record: Callable[..., Path]) -> None:
    data = record(extra=lambda q, v: -4.0 * v**3)
    few = ["cubic_drag", "quadratic_drag", "viscous_friction", "coulomb_friction"]
    report = diagnose(slide, [data], effects=few).as_dict()
    assert [e["name"] for e in report["effects"]] == ["cubic_drag"], report["reason"]
    c = report["effects"][0]["parameters"]["coefficient"]
    assert c["low"] <= 4.0 <= c["high"] and abs(c["value"] - 4.0) < 0.2 and report["held_out"]["low"] > 0.8


def test_what_a_recording_cannot_show_is_no_candidate() -> None:
    assert possible() == list(TABLE)  # every file has a row, but for these
    without = ["directional_gain", "frame_rotation", "local_gain", "rope_length", "sensor_noise", "state_torque"]
    assert [n for n in available() if n not in TABLE] == without
    assert all(facts_of(name) is None for name in without)


@pytest.mark.parametrize(
    ("unit", "size"),
    [
        ("N m or N", 2.0),
        ("N m s^2/rad^2 or N s^2/m^2", 2.0 / 9.0),
        ("N m/rad or N/m", 2.0 / 5.0),
        ("rad/s or m/s", 3.0),
        ("s", 5.0 / 3.0),
        ("kg m^2 or kg", 7.0),
        ("rad", 5.0),
        ("1", 1.0),
    ],
)
def test_sizes_follow_from_units(unit: str, size: float) -> None:
    of = size_from_unit(unit)
    assert of is not None and of(TypicalSizes(force=2.0, speed=3.0, travel=5.0, inertia=7.0)) == pytest.approx(size)


def test_units_that_are_not_mechanical_have_no_size() -> None:
    assert size_from_unit("") is size_from_unit("of the observation") is size_from_unit("K") is None
