"""What happens between command and drive, between machine and encoder, and in a gear with play."""

import numpy as np

from tools.studies.blind.library import LIBRARY
from tools.studies.blind.loop import Sensor, simulate, start
from tools.studies.blind.plants import PLANTS
from tools.studies.blind.truths import rows

SLIDE = PLANTS["slide"]
NUMBERS = {"m": 3.0, "armature": [1.0], "damping": [2.0], "dry": [0.0], "gear": [10.0], "limit": [1e9]}
TICKS, PER = 100, 10
COMMANDS = np.sin(np.arange(TICKS) * 0.1)[None, :, None]
REST = start(np.zeros((1, 1)), np.zeros((1, 1)))


def run(**change: float):
    p = rows(SLIDE, NUMBERS)
    for name, value in change.items():
        p[name][:] = value
    return simulate(SLIDE, p, REST, TICKS, PER, commands=COMMANDS)


def test_a_delayed_command_moves_everything_later() -> None:
    now, late = run(), run(delay=0.01)  # five ticks
    assert np.allclose(late.qpos[0, 5:], now.qpos[0, :-5], atol=1e-12)


def test_a_delayed_encoder_shows_the_same_as_a_delayed_command_but_not_the_same_force() -> None:
    sensor, command = run(sensor_delay=0.01), run(delay=0.01)
    assert np.abs(sensor.clean - command.clean).max() < 1e-9
    assert np.abs(sensor.force - command.force).max() > 0.1


def test_lag_dead_band_limit_gain_and_offset_change_the_force() -> None:
    assert np.allclose(run(gain=1.2, offset=0.1).force, 10 * (1.2 * COMMANDS + 0.1))
    assert np.allclose(run(limit=4.0).force, np.clip(10 * COMMANDS, -4, 4))
    dead = run(deadband=0.3).force
    assert np.allclose(dead, 10 * np.sign(COMMANDS) * np.maximum(np.abs(COMMANDS) - 0.3, 0))
    lagged = np.zeros(TICKS)
    for k in range(1, TICKS):  # exact for a command that is held
        lagged[k] = COMMANDS[0, k - 1, 0] + (lagged[k - 1] - COMMANDS[0, k - 1, 0]) * np.exp(-0.002 / 0.02)
    assert np.allclose(run(lag=0.02).force[0, :, 0], 10 * lagged, atol=1e-9)


def test_an_encoder_counts_in_steps_and_samples_off_the_tick() -> None:
    early = np.tile([0, 1, -1, 0], TICKS // 4)[None]
    sensor = Sensor(np.zeros((1, TICKS, 1)), np.full((1, 1), 1e-3), early)
    record = simulate(SLIDE, rows(SLIDE, NUMBERS), REST, TICKS, PER, commands=COMMANDS, sensor=sensor)
    assert np.allclose(record.qpos / 1e-3, np.round(record.qpos / 1e-3), atol=1e-9)
    assert np.abs(record.qpos - record.clean).max() <= 0.5e-3 + 1e-12
    assert np.allclose(record.time[0, :4], [0.0, 0.0022, 0.0038, 0.006])
    assert np.all(np.diff(record.time) > 0)


def test_a_gear_with_play_lets_the_rotor_move_alone() -> None:
    p = rows(SLIDE, NUMBERS)
    shape = {"sign": 1.0, "ratio": 0.5, "speed": 0.5}
    LIBRARY["backlash"].apply(p, np.array([0]), 0, 1e-3, shape, {})
    force = np.full((1, TICKS, 1), 0.1)  # 1 N on a rotor of 1 kg: 1 mm takes 45 ms
    y = simulate(SLIDE, p, REST, TICKS, PER, commands=force).state.y[:, :, 0, 0]
    touch = int(np.sqrt(2e-3 / 1.0) / 0.002)
    assert np.all(y[: touch - 1, 0] == 0)
    assert np.isclose(y[touch - 2, 3], 0.5 * ((touch - 2) * 0.002) ** 2, rtol=1e-6)
    assert y[-1, 0] > 1e-3 and abs(y[-1, 3] - y[-1, 0]) < 1.1e-3
