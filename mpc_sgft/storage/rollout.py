"""What one real rollout left behind, whether it was driven just now or is read back from its file."""

from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from mpc_sgft.storage.episode_file import Episode


class Press(NamedTuple):
    """What a person wants.

    Attributes:
        word: stop, pause, success, failure, rerecord, takeover or confirm.
        unix: When, by the computer's clock, [s].
        episode: The rollout that ran then, or else the last one that did; 0 before the first.
    """

    word: str
    unix: float
    episode: int


class Rollout(NamedTuple):
    """What one real episode of T steps left behind.

    Attributes:
        steps: Transitions, [T].
        qpos: At each observation, [T+1, nq]; None where the backend has none.
        plans: Mean of each step's plan [T, H, A]; None if the episode was read back from a file.
        values: What each plan was expected to return, [T].
        plan_ms: Time each plan took, [T].
        candidates: Of selected steps, (t, plans [N, H, A], values [N]).
        success: Whether the goal held at the end.
        aborted: Why the episode ended before its time, or None.
        keys: What a person pressed meanwhile.
        intervened: Whether a person took the arm over; then nothing is learned from the episode.
    """

    steps: TensorDict
    qpos: np.ndarray | None
    plans: Tensor | None
    values: Tensor | None
    plan_ms: np.ndarray | None
    candidates: list[tuple[int, Tensor, Tensor]]
    success: bool
    aborted: str | None
    keys: tuple[Press, ...] = ()
    intervened: bool = False

    def lesson(self, least: int) -> TensorDict | None:
        """What is learned from: the valid steps; None if they are fewer than `least`, or a person had the arm."""
        valid = self.steps[~self.steps["next", "invalid"][:, 0]]
        return valid if len(valid) >= least and not self.intervened else None


def from_episode(episode: Episode, number: int) -> Rollout:
    """A rollout from its recording; one that was cut off counts as aborted, and its whole steps are kept.

    Raises:
        ValueError: If not a single step is in it.
    """
    data = episode.transitions
    if not data:
        raise ValueError("the recording holds no step")
    count = len(data["step"])

    def column(key: str, dtype: torch.dtype) -> Tensor:
        return torch.as_tensor(np.asarray(data[key]), dtype=dtype).reshape(count, -1)

    flags = {key: column(key, torch.bool) for key in ("terminated", "truncated", "success", "invalid")}
    following = TensorDict(
        {
            "observation": column("next_observation", torch.float32),
            "reward": column("reward", torch.float32),
            "action_sent": column("action_sent", torch.float32),
            "done": flags["terminated"] | flags["truncated"],
            **flags,
        },
        [count],
    )
    steps = TensorDict(
        {
            "observation": column("observation", torch.float32),
            "action": column("action", torch.float32),
            "episode": torch.full((count,), number),
            "step": torch.arange(count),
            "next": following,
        },
        [count],
    )
    outcome = episode.outcome or {}
    aborted = outcome.get("aborted") if episode.complete else "cut off"
    success = bool(episode.complete and outcome.get("success", flags["success"][-1] and not aborted))
    keys = tuple(Press(row["key"], row["unix"], number) for row in episode.keys)
    intervened = bool(outcome.get("intervened") or episode.guided)
    return Rollout(steps, None, None, None, None, [], success, aborted, keys, intervened)
