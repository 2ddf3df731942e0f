"""Columns in another unit, of another joint, or swapped are refused; what effects do to sound ones is not."""

from __future__ import annotations

import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.data.measured import Table
from mpc_sgft.diagnose.data.units import Axis, check_order, check_speeds, check_units

T = np.arange(1000) * 0.004
ARM = {"elbow": Axis(-2.9, 2.9)}
SLIDE = {"x": Axis(-1.0, 1.0, slide=True)}


def table(**columns: np.ndarray) -> Table:
    return Table("run1", {"time": T, **{k.replace("__", "/"): v for k, v in columns.items()}})


@pytest.mark.parametrize(
    ("joints", "position", "words"),
    [
        (ARM, np.rad2deg(0.9 * np.sin(T)), r"elbow reaches \d+.*: degrees\? They are needed in rad"),
        (SLIDE, 1000 * 0.15 * np.sin(T), r"x reaches 150.*: millimetres\? They are needed in m"),
        (SLIDE, 100 * 0.5 * np.sin(T), r"x reaches \d+.*: centimetres or millimetres\?"),
        (SLIDE, 1e6 * np.sin(T), "another unit, or another joint"),
    ],
)
def test_positions_in_another_unit(joints: dict[str, Axis], position: np.ndarray, words: str) -> None:
    (name,) = joints
    with pytest.raises(UserError, match=words):
        check_units(table(**{f"qpos__{name}": position}), joints)


def test_positions_a_little_outside_the_range_are_sound() -> None:
    check_units(table(qpos__elbow=3.4 * np.sin(T)), ARM)
    check_units(table(qpos__elbow=1e3 * np.sin(T)), {"elbow": Axis()})  # a joint without range


@pytest.mark.parametrize(
    ("speed", "words"),
    [
        (
            np.rad2deg(np.cos(T)),
            "57.3 times the derivative of qpos/elbow. Positions are needed in rad, speeds",
        ),
        (-np.cos(T), "the sign opposite"),
        (np.cos(5.3 * T), "not the derivative.*another joint"),
    ],
)
def test_a_speed_is_the_derivative_of_its_position(speed: np.ndarray, words: str) -> None:
    with pytest.raises(UserError, match=words):
        check_speeds(table(qpos__elbow=np.sin(T), qvel__elbow=speed), ARM)


def test_an_even_speed_is_sound_and_its_unit_shows() -> None:
    even = 0.05 + 0.005 * np.random.default_rng(0).normal(size=1000)
    check_speeds(table(qpos__elbow=0.05 * T, qvel__elbow=even), ARM)
    with pytest.raises(UserError, match="57[.0-9]* times the derivative"):
        check_speeds(table(qpos__elbow=0.05 * T, qvel__elbow=np.degrees(even)), ARM)


def test_noisy_delayed_and_misread_speeds_are_sound() -> None:
    rng = np.random.default_rng(0)
    for speed in (np.cos(T) + 0.3 * rng.normal(size=1000), np.cos(T - 0.1), 1.3 * np.cos(T)):
        check_speeds(table(qpos__elbow=np.sin(T), qvel__elbow=speed), ARM)
    still = 1e-5 * rng.normal(size=1000)
    check_speeds(table(qpos__elbow=still, qvel__elbow=rng.normal(size=1000)), ARM)


def test_a_joint_does_not_move_before_it_is_told_to() -> None:
    command = np.sin(2 * T) + 0.4 * np.sin(9 * T)
    late = np.sin(2 * (T - 0.06)) + 0.4 * np.sin(9 * (T - 0.06))
    check_order(table(ctrl__servo=command, qpos__elbow=late), {"servo": "elbow"})
    with pytest.raises(UserError, match="15 samples earlier. Are commanded and measured positions swapped"):
        check_order(table(ctrl__servo=late, qpos__elbow=command), {"servo": "elbow"})
