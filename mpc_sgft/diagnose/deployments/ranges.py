"""How widely each draw of pretraining should vary to explain what a deployment recorded, by DROPO.

A window is simulated from measured joints and observed objects on, as for naming, but under the commands that were
sent, not under the drive that was measured: what weak or late servos make of them is then for the draws to explain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import yaml
from numpy.typing import NDArray
from omegaconf import OmegaConf
from torch import Tensor

from envs import randomize
from envs.randomize import Draw
from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError, from_config
from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.deployments.chain import Chain
from mpc_sgft.diagnose.deployments.command_link import measured_drive
from mpc_sgft.diagnose.deployments.motion_link import at_times
from mpc_sgft.diagnose.deployments.recordings import Deployment, run_config
from mpc_sgft.diagnose.fitting.dropo import ROUNDS, SAMPLES, dropo
from mpc_sgft.runs.build import drawn_ranges

LENGTH = 6  # control steps in a window
MOST = 64  # windows
FLAT, STEEP = 1e-3, 2.0  # a Beta distribution with a = 1 and b above this one is densest at 0


class Ranges(NamedTuple):
    """What was found.

    Attributes:
        randomize: As in configs/randomize/*.yaml, with the ranges found.
        draws: The draws it was looked for within, by their names.
        shapes: (a, b) of the Beta distribution over each draw's range, [D, 2].
        windows: That this rests on.
    """

    randomize: dict[str, Any]
    draws: dict[str, Draw]
    shapes: Tensor
    windows: int

    @property
    def at_an_end(self) -> list[str]:
        """Draws likeliest at an end of where they were looked for: the truth may lie beyond."""
        ends = (self.shapes.amin(1) < 1 + FLAT) & (self.shapes.amax(1) > STEEP)
        return [name for name, at_end in zip(self.draws, ends.tolist(), strict=True) if at_end]

    def table(self) -> str:
        """For the terminal."""
        lines = ["draw          | looked for within | found (90 %)"]
        for name, draw in self.draws.items():
            found = self.randomize["draws"][name]
            within = f"{draw.low:.4g} to {draw.high:.4g}"
            lines.append(f"{name:13} | {within:>17} | {found['low']:.4g} to {found['high']:.4g}")
        if self.at_an_end:
            lines.append(f"at an end of its range: {', '.join(self.at_an_end)}; look within a wider randomisation")
        return "\n".join(lines)

    def write(self, path: Path) -> None:
        """A file that `pretrain randomize=FILE` takes."""
        text = yaml.safe_dump(self.randomize, sort_keys=False)
        path.write_text("# Written by mpc_sgft.diagnose: the central 90 % of the distributions found.\n" + text)


def find_ranges(
    deployment: Deployment,
    entries: Mapping[str, Any],
    *,
    seed: int,
    rounds: int = ROUNDS,
    samples: int = SAMPLES,
    track: Callable[[range], Iterable[int]] = iter,
) -> Ranges:
    """The narrowest ranges of a randomisation's draws that explain a deployment.

    Args:
        deployment: Task and episodes.
        entries: As in configs/randomize/*.yaml; nothing is looked for outside its ranges.
        seed, rounds, samples: As in `dropo`.
        track: Shows how far the search is, as tqdm does.

    Raises:
        UserError: If nothing is drawn, a draw does not fit the scene, or no window can be cut.
    """
    chain = Chain(deployment, LENGTH, MOST)
    with from_config("randomize"):
        draws = dict(zip(entries["draws"], randomize.load(entries["draws"]), strict=True))
        simulator = _Simulator(chain, list(draws.values()))
    if not draws:
        raise UserError("--ranges: nothing is drawn there, so there is nothing to find. Give another one.")
    end = chain.observed[:, -1], chain.observation_scale[:, -1]
    how = {"seed": seed, "rounds": rounds, "samples": samples}
    shapes = dropo(simulator.outcomes, len(draws), *end, **how, track=track)
    found = {name: dict(entry) for name, entry in entries["draws"].items()}
    for name, (low, high) in drawn_ranges(draws, shapes).items():
        found[name] |= {"low": low, "high": high}
    return Ranges({**entries, "draws": found}, draws, shapes, len(chain.windows.start))


def randomisation(run: Path, name: str) -> dict[str, Any]:
    """configs/randomize/NAME.yaml, for the task of a run.

    Raises:
        UserError: For a name that is not there, or a folder that is not that of a deployment.
    """
    cfg = compose("pretrain", [f"task={run_config(run).chosen.task}", f"randomize={name}"], [])
    return cast(dict[str, Any], OmegaConf.to_container(cfg.randomize, resolve=True))


class _Simulator:
    """The scene with numbers drawn, over a deployment's windows."""

    def __init__(self, chain: Chain, draws: list[Draw]) -> None:
        self.chain, self.draws, self.commands = chain, draws, chain.commands
        self.own = chain.task.spec().compile()
        self.sent = self.commands.drive([()])[0]  # [E, T N, nu]
        self.everything = np.arange(len(chain.windows.start))
        randomize.changed(self.own, draws, [d.low for d in draws])  # a draw that does not fit says so now

    def outcomes(self, places: Array) -> Array:
        """Observations at the end of each window, [M, W, O], with the draws at places in their ranges [M, D]."""
        return np.stack([self._outcome([d.value(x) for d, x in zip(self.draws, p, strict=True)]) for p in places])

    def _outcome(self, values: list[float]) -> Array:
        motion = self.chain.motion
        late = randomize.changed(self.own, self.draws, values).actuator_delay  # [nu], which motion's scene leaves out
        model = randomize.changed(motion.model, self.draws, values)
        model.actuator_delay[:] = 0
        driven = [measured_drive(model, e) for e in motion.episodes]

        def controls(episode: int, ends: NDArray[np.floating]) -> Array:
            """From what gave the force measured at a window's start, by as much as was commanded since."""
            begin = ends[:, :1] - motion.h
            first = at_times(motion.episodes[episode].time, driven[episode], begin)
            return first + self._arrived(episode, ends, late) - self._arrived(episode, begin, late)

        return motion.run(model, (), self.everything, controls=controls).observation[:, -1]

    def _arrived(self, episode: int, when: NDArray[np.floating], late: Array) -> Array:
        sent, times = self.sent[episode].T, self.commands.times
        return np.stack([np.interp(when - d, times, u) for d, u in zip(late, sent, strict=True)], -1)
