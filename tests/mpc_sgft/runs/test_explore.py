"""Simulated episodes of a pretrained policy, for methods that go on learning from them."""

import torch

from mpc_sgft.command.compose import compose
from mpc_sgft.runs import build
from mpc_sgft.runs.explore import explored


def test_explored_episodes_are_those_of_pretraining_and_follow_the_seed() -> None:
    agent, _ = build.load_agent(compose("deploy", [], []))
    weights = {k: v.clone() for k, v in agent.model.state_dict().items()}
    steps = explored(0, "push", agent.model, 6)
    assert steps.shape == (6, 40) and steps["observation"].shape[-1] == agent.model.obs_dim
    assert steps["next", "success"].any(), "the shipped policy can push"
    assert torch.equal(explored(0, "push", agent.model, 6)["action"], steps["action"])
    assert not torch.equal(explored(1, "push", agent.model, 6)["action"], steps["action"])
    assert all(torch.equal(v, weights[k]) for k, v in agent.model.state_dict().items())
