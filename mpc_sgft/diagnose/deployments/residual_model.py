"""A residual model without a name for a deployment: what each link of its chain missed in a control step.

It is foretold by smooth random functions of what was commanded, seen and measured when the step began.

Links are independent of each other, so the fit is a ridge regression for each of their numbers, of what a set of
effects leaves. It says whether there is a law that no name holds, not what the law is.
"""

from __future__ import annotations

import numpy as np

from mpc_sgft.diagnose.data.measured import Array, Index
from mpc_sgft.diagnose.deployments.chain import Chain, Prediction, effects_of
from mpc_sgft.diagnose.deployments.motion_link import JOINT_SAMPLES, at_times
from mpc_sgft.diagnose.fitting.fit import by_parts
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.fitting.prepare import Setup
from mpc_sgft.diagnose.fitting.residual_model import RIDGES, ResidualModel, left_out, solve

BEFORE = 3  # commands that a step may depend on, its own the last
RANDOM, WIDTHS = 60, (0.1, 0.3, 0.6)  # smooth functions, and how fast they change
SHARP = 3.0  # of a direction of motion: tanh of so many typical speeds


def fit_residual_model(setup: Setup[Chain], best: Hypothesis, rng: np.random.Generator) -> ResidualModel:
    """Fit what a set of effects leaves; errors of fitted windows are those of a model without their block."""
    chain, everything = setup.problem, np.arange(len(setup.fitted) + len(setup.held))
    y = Prediction(*(x[0] for x in chain.predict([effects_of(best.terms, best.values)], everything)))
    x = features(chain, best, rng)  # [W, n, F]
    ends = slice(JOINT_SAMPLES - 1, None, JOINT_SAMPLES)
    links = (
        (chain.observed - y.observation, chain.observation_scale),
        ((chain.drive - y.drive)[:, ends], np.full(chain.drive[:, ends].shape, chain.drive_scale)),
        (-y.joints[:, ends], chain.joint_scale[:, ends]),
    )
    seen, drive, joints = (_foretell(x, missed, scale, setup) for missed, scale in links)
    drive = np.where(chain.untold, 0.0, _between(drive))
    corrected = Prediction(y.drive + drive, y.joints + _between(joints), y.observation + seen)
    squares = chain.joined(Prediction(*(part[None] for part in corrected)), everything)[0] ** 2
    order = np.concatenate([setup.fitted, setup.held])
    return ResidualModel(setup.judged(by_parts(squares[order], setup.parts)))


def features(chain: Chain, best: Hypothesis, rng: np.random.Generator) -> Array:
    """Of each control step: a constant, what is known when it begins, and functions of that, [W, n, F]."""
    told = chain.commands.drive([effects_of(best.terms, best.values)])[0]  # [E, S, nu], of every physics step
    rows = [
        _known(chain, told[i], int(i), int(s)) for i, s in zip(chain.windows.episode, chain.windows.start, strict=True)
    ]
    x = np.stack(rows)
    spread = x.std((0, 1))
    x = x[..., spread > 1e-9] / spread[spread > 1e-9]
    x = x - x.mean((0, 1))
    waves = np.cos(
        x @ (rng.normal(size=(x.shape[-1], RANDOM)) * rng.choice(WIDTHS, RANDOM)) + rng.uniform(0, 2 * np.pi, RANDOM)
    )
    return np.concatenate([np.ones((*x.shape[:2], 1)), x, np.tanh(SHARP * x), waves], -1)


def _known(chain: Chain, told: Array, episode: int, start: int) -> Array:
    """What the last commands asked of the servos, observation and joints as a step begins, and how they moved, [n, F].

    Args:
        chain: The deployment.
        told: Control at the servos, after every physics step of the episode, [S, nu].
        episode, start: Of the window.
    """
    e, steps = chain.episodes[episode], np.arange(start, start + chain.windows.samples)
    each = round(chain.task.control_dt / chain.task.sim_dt)
    ends = told[each - 1 :: each]  # of each control step
    asked = np.diff(ends, axis=0, prepend=ends[:1])  # of the first step nothing is known
    asked = np.concatenate([np.zeros((BEFORE - 1, asked.shape[1])), asked])
    now, before = e.observation[steps], e.observation[np.maximum(steps - 1, 0)]
    q, was = (at_times(e.time, e.q, chain.task.control_dt * np.maximum(s, 0)) for s in (steps, steps - 1))
    return np.concatenate([*(asked[steps + k] for k in range(BEFORE)), now, now - before, q, q - was], -1)


def _foretell(x: Array, missed: Array, scale: Array, setup: Setup[Chain]) -> Array:
    """What was missed since a window's start, by the law of its steps, [W, n, S]; 0 where no law foretells anything.

    Args:
        x: Features of each step, [W, n, F].
        missed: Since the window's start, at the end of each step, [W, n, S].
        scale: Standard deviation if nothing is missing, [W, n, S].
        setup: Fitted and held windows, and blocks.
    """
    along, out = np.cumsum(x, 1), np.zeros(missed.shape)  # what a law of steps adds up to
    for s in range(missed.shape[-1]):
        weight = 1 / scale[..., s]
        a, r = along * weight[..., None], missed[..., s] * weight
        out[..., s] = _ridge(a, r, setup.fitted, setup.blocks) / weight
    return out


def _ridge(a: Array, r: Array, fitted: Index, blocks: Index) -> Array:
    """The regression of r [W, n] on a [W, n, F], of fitted windows without their own block, [W, n]."""
    a = a / (np.sqrt((a[fitted] ** 2).mean((0, 1))) + 1e-12)
    x, y, told = a[fitted], r[fitted], np.zeros(r.shape)
    each = np.full(a.shape[-1], float(y.size))
    choices = [(left_out(x, y, blocks, ridge * each), ridge) for ridge in RIDGES]
    left, ridge = min(choices, key=lambda c: _size(c[0]))
    if _size(left) < _size(y):
        told = -a @ solve(x, y, ridge * each)
        told[fitted] = y - left
    return told


def _size(r: Array) -> float:
    return float(np.log1p((r**2).mean(1)).mean())


def _between(ends: Array) -> Array:
    """Changes at the ends of steps [W, n, S] -> at the samples within, [W, n J, S], straight lines."""
    first = np.concatenate([np.zeros_like(ends[:, :1]), ends[:, :-1]], 1)
    share = np.arange(1, JOINT_SAMPLES + 1) / JOINT_SAMPLES
    within = first[:, :, None] + share[:, None] * (ends - first)[:, :, None]
    return within.reshape(len(ends), -1, ends.shape[-1])
