"""Planning with a gap's own physics: what is imagined is what then happens, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build
from tools.studies.exact_dynamics import ExactModel, measure


@pytest.mark.parametrize("gap", ["turned", "sluggish", "glide"])
def test_imagined_steps_are_those_that_happen(gap: str) -> None:
    cfg = compose("deploy", [f"gap={gap}"], [])
    agent, _ = build.load_agent(cfg)
    env = build.make_env(cfg, 2)
    model = ExactModel(agent.model, env, lambda n: build.make_env(cfg, n), true_reward=True)
    env.set_seed(3)
    state, generator = env.reset(), torch.Generator().manual_seed(0)
    actions = (2 * torch.rand(9, 2, 2, generator=generator) - 1).double()
    for action in actions[:5]:
        state = env.step(state.set("action", action.float()))["next"]
    z = model.encode(state["observation"])
    plans = torch.stack([actions[5:], -actions[5:]], 2)  # the second is only imagined [4, 2, 2, 2]
    imagined, rewards = z.unsqueeze(1).expand(-1, 2, -1), []
    for action in plans:
        before, imagined = imagined, model.next(imagined, action)
        rewards.append(model.reward(before, action, imagined)[:, 0])
    for action, reward in zip(actions[5:], rewards, strict=True):
        state = env.step(state.set("action", action.float()))["next"]
        np.testing.assert_allclose(state["reward"][:, 0], reward, atol=1e-6)
    np.testing.assert_array_equal(state["observation"], imagined[:, 0, -env.obs_dim :].float())
    assert (imagined[:, 1] != imagined[:, 0]).any()


def test_a_gap_whose_sensor_is_late_is_refused() -> None:
    cfg = compose("deploy", ["+gap.effects.sensor_delay.delay=0.1"], [])
    agent, _ = build.load_agent(cfg)
    with pytest.raises(ValueError, match="late sensor"):
        ExactModel(agent.model, build.make_env(cfg, 1), lambda n: build.make_env(cfg, n), true_reward=False)


def test_another_task_is_measured_with_the_settings_it_is_given() -> None:
    small = ["planner.num_candidates=8", "planner.num_elites=4", "planner.num_prior=2", "planner.iterations=1"]
    row = measure("insert_real", 1, "learned", 1, ["task=insert", "task.env.episode_steps=3", *small])
    assert row["gap"] == "insert_real" and row["episodes"] == 1 and np.isfinite(row["episode_return"])
    with pytest.raises(UserError, match="No checkpoint"):
        measure("insert_real", 1, "learned", 1, ["task=insert", "checkpoint=nowhere"])
