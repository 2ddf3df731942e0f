"""Reference motions: multisines, steps, slow and fast motion, quick reversals, holds; smoothed, and within limits."""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from tools.studies.blind.plants import Array

KINDS = ("multisine", "steps", "slow", "fast", "reversals", "hold")
LIVELY = ("multisine", "fast", "steps")
AMPLITUDE = {"slide": 0.25, "hinge": 0.9}  # m, rad
SPEED = {"slide": 0.5, "hinge": 3.0}  # m/s, rad/s
ACCELERATION = {"slide": 4.0, "hinge": 20.0}  # m/s^2, rad/s^2
CORNER = 25.0  # [rad/s] of the three equal low passes that smooth a reference


class Reference(NamedTuple):
    """Position, velocity, acceleration to follow, [T, n] each."""

    position: Array
    velocity: Array
    acceleration: Array


def plan(rng: np.random.Generator, episodes: int) -> list[tuple[str, ...]]:
    """Three kinds of motion for each episode; each has a lively one and a calm one."""
    plans = []
    for _ in range(episodes):
        kinds = [rng.choice(LIVELY), rng.choice(("slow", "reversals", "hold")), rng.choice(KINDS)]
        plans.append(tuple(str(k) for k in rng.permutation(kinds)))
    return plans


def reference(
    kinds: tuple[str, ...], joints: tuple[str, ...], count: int, dt: float, rng: np.random.Generator
) -> Reference:
    """A motion made of equally long parts of these kinds.

    Args:
        kinds: Of KINDS.
        joints: "slide" or "hinge" for each joint that is moved.
        count: T, samples.
        dt: [s] between them.
        rng: Where levels, frequencies and phases come from.
    """
    raw = np.stack([_joint(kinds, joint, count, dt, rng) for joint in joints], 1)
    pole = np.exp(-CORNER * dt)
    smooth = raw - raw[0]
    for _ in range(3):
        smooth = lfilter([1 - pole], [1, -pole], smooth, axis=0)
    smooth = np.asarray(smooth)
    velocity = np.gradient(smooth, dt, axis=0)
    acceleration = np.gradient(velocity, dt, axis=0)
    caps = np.array([[SPEED[j] for j in joints], [ACCELERATION[j] for j in joints]])
    tops = np.array([np.abs(velocity).max(0), np.abs(acceleration).max(0)])
    shrink = np.minimum(1.0, (caps / np.maximum(tops, 1e-12)).min(0))
    return Reference(raw[0] + shrink * smooth, shrink * velocity, shrink * acceleration)


def _joint(kinds: tuple[str, ...], joint: str, count: int, dt: float, rng: np.random.Generator) -> Array:
    """One joint's unsmoothed motion, [T]; each part starts where the one before ended."""
    size = AMPLITUDE[joint]
    level, parts = float(rng.uniform(-0.3, 0.3)) * size, []
    for piece in np.array_split(np.arange(count), len(kinds)):
        t = np.arange(len(piece)) * dt
        wave = size * _wave(kinds[len(parts)], t, rng)
        parts.append(level + wave - (wave[0] if len(wave) else 0.0))
        level = float(np.clip(parts[-1][-1], -size, size)) if len(wave) else level
    return np.concatenate(parts)


def _wave(kind: str, t: Array, rng: np.random.Generator) -> Array:
    """One part in units of the amplitude, [len(t)]."""
    if kind == "hold":
        return np.zeros_like(t)
    if kind == "multisine":
        frequency = np.exp(rng.uniform(np.log(0.2), np.log(2.5), 5))
        phase = rng.uniform(0, 2 * np.pi, 5)
        wave = np.sum(np.sin(2 * np.pi * frequency[:, None] * t + phase[:, None]) / frequency[:, None] ** 0.7, 0)
        return wave / np.abs(wave).max()
    if kind == "steps":
        edges = np.cumsum(rng.uniform(0.3, 0.9, 50))
        return rng.uniform(-0.9, 0.9, 51)[np.searchsorted(edges, t)]
    if kind == "slow":
        return _triangle(t, speed=rng.uniform(0.08, 0.3), period=rng.uniform(1.0, 2.5), phase=rng.uniform())
    if kind == "fast":
        return rng.uniform(0.3, 0.6) * np.sin(2 * np.pi * rng.uniform(1.0, 2.5) * t)
    if kind == "chirp":  # not drawn by `plan`
        low, high, seconds = rng.uniform(0.1, 0.3), rng.uniform(1.5, 3.0), max(float(t[-1]), 1e-9)
        return 0.5 * np.sin(2 * np.pi * (low * t + (high - low) * t * t / (2 * seconds)))
    if kind == "reversals":
        return _triangle(t, speed=rng.uniform(0.4, 1.2), period=rng.uniform(0.3, 0.8), phase=rng.uniform())
    raise ValueError(f"No motion {kind!r}; allowed are {', '.join(KINDS)}, chirp.")


def _triangle(t: Array, speed: float, period: float, phase: float) -> Array:
    """Back and forth at constant speed [amplitudes / s]."""
    place = (t / period + phase) % 1.0
    return speed * period * (np.where(place < 0.5, place, 1.0 - place))
