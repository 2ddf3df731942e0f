"""The benchmark as someone from elsewhere meets it: names, rollouts that are counted, the episodes of the results."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from mpc_sgft import benchmark
from mpc_sgft.benchmark import BudgetSpent, RealRollouts
from mpc_sgft.command import choices
from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build
from mpc_sgft.runs.pretrain import prior
from mpc_sgft.runs.real_rollout import begin, start_seed

STILL = np.zeros(2, np.float32)


def episode(env: gymnasium.Env) -> int:
    """Steps of a whole episode."""
    env.reset()
    for step in range(1, 1000):
        *_, terminated, truncated, _ = env.step(STILL)
        if terminated or truncated:
            return step
    raise AssertionError("the episode does not end")


def test_every_name_is_a_task_and_a_gap_of_ours() -> None:
    groups = choices.groups()
    for task, gaps in benchmark.GAPS.items():
        assert task in groups["task"] and set(gaps.values()) <= set(groups["gap"])
        assert not [gap for gap in gaps.values() if gap.startswith("dev_")], "these are for tuning"
        assert gymnasium.spec(f"mpc_sgft/{task}-sim-v0").kwargs == {"task": task}
    assert gymnasium.make("mpc_sgft/push-turned-v0", rollouts=3).unwrapped.rollouts == 3


def test_rollouts_are_counted_and_end() -> None:
    env = RealRollouts("push", "turned", rollouts=2)
    with pytest.raises(ResetNeeded):
        env.step(STILL)
    env.reset()
    env.reset()  # nothing has moved yet
    assert env.spent == 0
    assert episode(env) == 40 and env.spent == 1
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(STILL)
    env.reset()
    assert env.step(STILL)[-1]["spent"] == 2
    env.reset()  # gives the second one up; that it was begun stays
    with pytest.raises(BudgetSpent, match="All 2 real rollouts"):
        env.step(STILL)
    with pytest.raises(ValueError, match="rollouts=0"):
        RealRollouts("push", "turned", rollouts=0)


def test_rollouts_start_as_those_of_deploy() -> None:
    env = RealRollouts("push", "turned", seed=3)
    episode(env)
    second, _ = env.reset(seed=99)
    cfg = compose("deploy", ["gap=turned"], [])
    theirs = build.make_env(cfg, 1)
    np.testing.assert_array_equal(second, begin(theirs, start_seed(3, 2))["observation"][0].numpy())


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_checks_the_simulator() -> None:
    check_env(benchmark.simulated("push"))


def test_the_simulator_is_drawn_anew_each_episode() -> None:
    env = gymnasium.make("mpc_sgft/push-sim-v0").unwrapped
    masses = []
    for _ in range(3):
        env.reset()
        masses.append(env.env.backend.randomizer.arrays["body_mass"][0].copy())
    assert len({mass.tobytes() for mass in masses}) == 3
    env = RealRollouts("push", "turned")
    env.reset()
    assert not env.env.backend.randomizer.arrays, "there is one reality"


def test_the_simulator_starts_as_pretraining_does() -> None:
    task = gymnasium.make("mpc_sgft/push-sim-v0").unwrapped.env.task
    assert task.stray_share == compose("pretrain", ["task=push"], []).task.in_training.stray_share > 0


def test_a_policy_that_knows_the_gap_scores_and_one_that_does_not_fails() -> None:
    task = build.make_env(compose("evaluate", [], []), 1).task

    def scripted(observation: np.ndarray) -> np.ndarray:
        return task.scripted(observation[:, :4].astype(float))

    def turned_back(observation: np.ndarray) -> np.ndarray:
        action, (cos, sin) = scripted(observation), (np.cos(-0.6), np.sin(-0.6))
        return np.clip(2 * action @ np.array([[cos, sin], [-sin, cos]]), -1, 1)

    name = "mpc_sgft/push-turned-v0"
    assert benchmark.evaluate(name, scripted, episodes=16).success < 0.3
    assert benchmark.evaluate(name, turned_back, episodes=16).success > 0.7
    assert benchmark.evaluate("mpc_sgft/push-sim-v0", scripted, episodes=16).success < 0.5, "it knows no delays"
    pretrained = prior(build.load_agent(compose("evaluate", [], []))[0])

    def trained(observation: np.ndarray) -> np.ndarray:
        return pretrained(torch.from_numpy(observation), torch.ones(len(observation), dtype=torch.bool)).numpy()

    assert benchmark.evaluate("mpc_sgft/push-sim-v0", trained, episodes=16).success > 0.9


def test_another_name_is_refused() -> None:
    with pytest.raises(UserError, match="push-turned-v0"):
        benchmark.evaluate("CartPole-v1", lambda observation: observation)


def test_actions_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(2,\); wanted is \(4, 2\)"):
        benchmark.evaluate("mpc_sgft/push-sim-v0", lambda observation: STILL, episodes=4)


def test_the_page_has_the_names() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "benchmark.md").read_text()
    assert all(f"`{task}`" in page for task in benchmark.GAPS)
