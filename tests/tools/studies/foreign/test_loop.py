"""Commands arrive exactly as late as they should, and encoders show what they should."""

import numpy as np
import pytest

from tools.studies.foreign.loop import Record, Sensor, simulate
from tools.studies.foreign.scenes import SCENES, parameters
from tools.studies.foreign.stiff import Stiff

SLIDE = SCENES["slide"]
NUMBERS = {"m": [3.0], "c": [0.0], "l": [0.0], "i": [0.01], "armature": [1.0], "damping": [0.0], "dry": [0.0]}
NUMBERS |= {"gear": [10.0], "limit": [1e9]}
TICKS, DT = 100, 0.005
COMMANDS = np.sin(np.arange(TICKS) * 0.1)[:, None]


def run(sensor: Sensor | None = None, commands=COMMANDS, **change: float) -> Record:
    p = parameters(SLIDE, NUMBERS)
    for name, value in change.items():
        p[name][:] = value
    return simulate(Stiff(SLIDE, p), p, (np.zeros(1), np.zeros(1)), TICKS, DT, commands, sensor)


def test_fifty_microseconds_late_is_what_they_do_to_a_step() -> None:
    step = np.r_[np.zeros(10), np.ones(90)][:, None]
    late = (TICKS - 1 - 10) * DT - 5e-5  # 10 N on 4 kg
    assert run(commands=step, delay=5e-5).v[-1, 0] == pytest.approx(2.5 * late, rel=1e-6)
    assert run(commands=step, delay=0.0125).v[-1, 0] == pytest.approx(2.5 * (late + 5e-5 - 0.0125), rel=1e-6)


def test_whole_ticks_late_move_everything_later() -> None:
    assert np.allclose(run(delay=0.01).q[2:], run().q[:-2], atol=1e-8)


def test_a_sensor_between_ticks_reads_what_was_there() -> None:
    now, late = run(), run(sensor_delay=0.0025)
    force = 10 * COMMANDS[:-1] / 4.0  # constant over a tick, so the middle is exact
    middle = now.q[:-1] + now.v[:-1] * DT / 2 + force * DT**2 / 8
    assert np.allclose(late.clean[1:], middle, atol=1e-8)


def test_encoders_scale_shift_and_count() -> None:
    seen = run(Sensor(np.zeros((TICKS, 1)), np.array([1e-3])), sensor_gain=1.02, sensor_offset=0.0123)
    assert np.allclose(seen.clean, 1.02 * seen.q + 0.0123)
    assert np.allclose(seen.read / 1e-3, np.round(seen.read / 1e-3), atol=1e-9)
    assert 1e-4 < np.abs(seen.read - seen.clean).max() <= 0.5e-3 + 1e-12


def test_gain_offset_and_dead_band_act_on_the_command() -> None:
    assert np.allclose(run(gain=1.2, offset=0.1).force, 10 * (1.2 * COMMANDS + 0.1))
    dead = 10 * np.sign(COMMANDS) * np.maximum(np.abs(COMMANDS) - 0.3, 0)
    assert np.allclose(run(deadband=0.3).force, dead)
