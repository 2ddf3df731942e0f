"""The next experiment on a task: recorded actions, changed, whose simulated outcome separates tied candidates best."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from envs.backends.sim import SimBackend
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.deployments.chain import RESOLUTION, Chain, effects_of
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis
from mpc_sgft.diagnose.verdict.next_experiment import best_of, separation

STARTS = 4  # simulated episodes for each proposal
TIED = 3  # candidates that are compared


def _proposals() -> dict[str, Callable[[Array], Array]]:
    """Words -> change of actions [T, E, A]."""
    return {
        "slower: the same actions at half their size": lambda a: 0.5 * a,
        "faster: the same actions at one and a half times their size": lambda a: np.clip(1.5 * a, -1, 1),
        "reversals: every second action backwards": lambda a: a * np.where(np.arange(len(a)) % 2, -1, 1)[:, None, None],
        "stop and go: three actions, then three periods without one": lambda a: (
            a * (np.arange(len(a)) // 3 % 2 == 0)[:, None, None]
        ),
        "a hold: no action": lambda a: 0 * a,
    }


def next_experiment(chain: Chain, tied: Sequence[Hypothesis]) -> str:
    """Words for the proposal that separates the tied candidates best, and by how many times the noise."""
    scale = np.hypot(RESOLUTION, chain.noise)
    backends = [
        SimBackend(chain.task, STARTS, effects=list(effects_of(e.terms, e.values))) for e in tied[:TIED]
    ]  # the same starts for all
    outcomes = {}
    for words, change in _proposals().items():
        action = change(repeated(chain.commands.action))
        seen = np.array([_observe(b, action) for b in backends]) / scale
        outcomes[words] = separation(seen)
    otherwise = "measure a force, weigh the object, or put a known load on it"
    return best_of(outcomes, "motions", otherwise)


def repeated(action: Array) -> Array:
    """Actions of STARTS episodes, [T, STARTS, A], of recorded ones [T, E, A], some twice if they are fewer."""
    return action[:, np.arange(STARTS) % action.shape[1]]


def _observe(backend: SimBackend, action: Array) -> Array:
    """Observations of an episode without feedback, [T, E, O]."""
    backend.seed(0)
    backend.reset(np.arange(STARTS))
    return np.array([backend.send(a).observation for a in action])
