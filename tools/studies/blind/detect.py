"""The detectable size of an effect, from the noise.

The solver starts its model at the measured state and lets it run for a window. An effect is *detectable* at the size at
which what it alone does to the measured trajectory within such a window, root mean square over windows of WINDOW
seconds, equals the noise floor of the encoder, sqrt(sd^2 + step^2 / 12), on the joint where it shows most. Noise, steps
and jitter are left out of the two runs that are compared; both follow the same recorded commands, and the nominal one
starts from what the sensors say of the other after LEAD seconds, so an effect that only shifts the start shows nothing.
Delays and lags are not asked for below half the solver's time step (library.SMALLEST_TIME).
"""

from collections.abc import Callable

import numpy as np

from tools.studies.blind.loop import H, Record, simulate, start
from tools.studies.blind.plants import Array, Plant, Rows

WINDOW = 0.5  # [s]
LEAD = 0.24  # [s] before each window in which transmissions, bristles and delays settle
MOST_WINDOWS = 6  # of one machine
ROUNDS = 5


def window_starts(seconds: Array, owner: Array, dt: float, window: float = WINDOW) -> tuple[Array, Array]:
    """Where windows begin, evenly spread, at most MOST_WINDOWS for each owner.

    Args:
        seconds: Length of each row [s], [R].
        owner: Case that each row belongs to, [R].
        dt: Tick [s].
        window: Length [s].

    Returns:
        Row and tick of each window (with its lead), [W] each.
    """
    span = LEAD + window
    row, tick = [], []
    for case in np.unique(owner):
        mine = []
        for r in np.flatnonzero(owner == case):
            last = max(int(round((seconds[r] - span) / dt)), 0)
            mine += [(r, k) for k in range(0, last + 1, max(int(span / dt), 1))]
        for i in np.unique(np.linspace(0, len(mine) - 1, MOST_WINDOWS).astype(int)):
            row.append(mine[i][0])
            tick.append(mine[i][1])
    return np.array(row), np.array(tick)


def trace(
    plant: Plant,
    truth: Rows,
    nominal: Rows,
    reference: Record,
    row: Array,
    tick: Array,
    dt: float,
    floor: Array,
    force_floor: Array | None = None,
    window: float = WINDOW,
) -> Array:
    """What the effect changes in what is measured, in noise floors, [W, T, n + a], for W windows.

    Args:
        plant: The kind of machine.
        truth: Parameters with the effect, a row for each window.
        nominal: Parameters without it, likewise.
        reference: A run without the effect; its states and commands are the windows' beginnings.
        row: Row of `reference` of each window, [W].
        tick: Tick at which its lead begins, [W].
        dt: Tick [s].
        floor: Noise floor [m or rad], [W, n].
        force_floor: Of the measured forces of the drives [N or N m], inf where none is measured, [W, a]; or None.
        window: Length [s].
    """
    lead, total = round(LEAD / dt), round((LEAD + window) / dt)
    total = min(total, reference.ctrl.shape[1])
    per_tick = round(dt / H)
    ctrl = np.stack([reference.ctrl[r, k : k + total] for r, k in zip(row, tick, strict=True)])
    y = np.stack([reference.state.y[k, :, r] for r, k in zip(row, tick, strict=True)], 1)
    with np.errstate(all="ignore"):  # a trial size may make a machine unstable: then its change is not finite
        real = simulate(plant, truth, start(y[0], y[1]), total, per_tick, commands=ctrl)
        begin = start(real.clean[:, lead], real.clean_speed[:, lead])
        model = simulate(plant, nominal, begin, total - lead, per_tick, commands=ctrl[:, lead:])
        apart = (real.clean[:, lead:] - model.clean) / floor[:, None]
        if force_floor is None:
            return apart
        return np.concatenate([apart, (real.force[:, lead:] - model.force) / force_floor[:, None]], 2)


def size_of(traces: Array) -> Array:
    """Root mean square over time, [W, T, n] -> [W, n]."""
    with np.errstate(all="ignore"):
        return np.sqrt(np.mean(traces**2, 1))


def detectable(
    ratio: Callable[[Array], Array], guess: Array, largest: Array, smallest: Array, rounds: int = ROUNDS
) -> Array:
    """Size at which `ratio` is 1, for many cases at once, by a secant search on logarithms.

    Args:
        ratio: Sizes -> change in noise floors, [C] -> [C].
        guess: Sizes to begin with, [C].
        largest: Sizes never exceed this, [C].
        smallest: … nor fall below this, [C].
        rounds: How often `ratio` is evaluated.

    Returns:
        Sizes, [C]; nan where even the largest size changes less than half a noise floor.
    """
    bottom = np.maximum(smallest, 1e-6 * largest)
    size = np.clip(guess, bottom, largest)
    old_size, old_value, value = size, np.ones_like(size), np.zeros_like(size)
    for i in range(rounds):
        value = np.maximum(ratio(size), 1e-9)
        slope = np.ones_like(size)
        if i:
            moved = np.log(size / old_size)
            steep = np.log(value / old_value) / np.where(np.abs(moved) > 1e-3, moved, 1.0)
            slope = np.where(np.abs(moved) > 1e-3, np.clip(steep, 0.4, 4.0), 1.0)
        step = np.clip(-np.log(value) / slope, -5, 5)
        old_size, old_value = size, value
        size = np.clip(size * np.exp(step), bottom, largest)
    never = (size >= largest) & (value < 0.5)
    return np.where(never, np.nan, size)
