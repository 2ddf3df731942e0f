"""A world that only counts, sent down the whole path: every slice still counts by one in one episode."""

import numpy as np
import pytest
import torch

from envs.backends.base import Outcome
from envs.env import ControlEnv
from mpc_sgft.learning.buffer import make_buffer
from mpc_sgft.runs.collect import collect, score


class Counter:
    """Observes (episode, steps so far); the physics of environment 1 fails now and then."""

    name, observation_names, action_dim, episode_steps, control_dt = "count", ("episode", "count"), 1, 7, 0.2

    def __init__(self, num_envs: int, unstable_at: int | None = None):
        self.task, self.num_envs, self.unstable_at = self, num_envs, unstable_at
        self.episode, self.count, self.clock = np.zeros(num_envs), np.zeros(num_envs), 0

    def seed(self, seed: int) -> None:
        self.clock = 0

    def reset(self, sims: np.ndarray) -> np.ndarray:
        self.episode[sims] += 100 + sims
        self.count[sims] = 0
        return np.stack([self.episode, self.count], 1)[sims]

    def send(self, action: np.ndarray) -> Outcome:
        self.count += 1
        self.clock += 1
        invalid = np.zeros(self.num_envs, bool)
        if self.unstable_at is not None:
            invalid[1] = self.clock == self.unstable_at
        observation = np.stack([self.episode, np.where(invalid, 1e9, self.count)], 1)
        no = np.zeros(self.num_envs, bool)
        return Outcome(observation, self.count.copy(), self.count >= 7, no, action, invalid)


def counted(num_envs: int, rounds: int, history: int = 0, unstable_at: int | None = None):
    env = ControlEnv(Counter(num_envs, unstable_at), history=history)
    buffer = make_buffer(capacity=100, slice_len=3, batch_size=400, seed=0)
    episode = 0
    for k in range(rounds):
        data = collect(env, lambda o, fresh: o[:, 1:2] / 10, seed=k, first_episode=episode)
        episode = int(data["episode"].max()) + 1
        buffer.extend(data)
    return buffer, data


@pytest.mark.parametrize(("num_envs", "rounds", "unstable_at"), [(1, 3, None), (3, 2, None), (3, 2, 4), (4, 6, 4)])
def test_every_slice_counts_by_one(num_envs, rounds, unstable_at):
    buffer, _ = counted(num_envs, rounds, unstable_at=unstable_at)
    slices = buffer.sample()
    now, following = slices["observation"], slices["next", "observation"]
    assert (following[..., 1] == now[..., 1] + 1).all()  # a step counts one
    assert (now[:, 1:, 1] == now[:, :-1, 1] + 1).all()  # so does a slice
    assert (now[..., 0] == now[:, :1, 0]).all() and (following[..., 0] == now[..., 0]).all()  # within one episode
    assert (slices["next", "reward"][..., 0] == following[..., 1]).all()
    assert torch.allclose(slices["action"][..., 0], now[..., 1] / 10)


def test_unstable_steps_never_reach_the_buffer():
    buffer, data = counted(3, 2, unstable_at=4)
    assert data["next", "invalid"].sum() == 1
    assert (buffer.sample()["next", "observation"] < 1e8).all()


def test_history_is_newest_first_and_starts_empty():
    _, data = counted(1, 1, history=2)
    third = data["observation"][0, 3]  # o_3, o_2, o_1, a_2, a_1
    assert third[[1, 3, 5]].tolist() == [3, 2, 1]
    assert torch.allclose(third[6:], torch.tensor([0.2, 0.1]))
    assert data["observation"][0, 0][[1, 3, 5, 6, 7]].tolist() == [0, 0, 0, 0, 0]


def test_success_is_read_at_the_end_of_the_first_episode():
    _, data = counted(3, 1, unstable_at=4)
    result = score(data)
    assert (result.episodes, result.successes) == (3, 2)  # the unstable episode did not succeed
    assert result.success_low < 2 / 3 < result.success_high


def test_an_observation_that_is_not_finite_stops_and_is_named():
    world = Counter(2)
    env = ControlEnv(world)
    state = env.reset()
    world.count[1] = np.nan
    with pytest.raises(FloatingPointError, match="observation count is not finite in environment 1"):
        env.step(state.set("action", torch.zeros(2, 1)))
