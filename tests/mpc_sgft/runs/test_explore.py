"""Simulated episodes of a pretrained policy, for methods that go on learning from them."""

import pytest
import torch

from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build, explore
from mpc_sgft.runs.explore import explored
from mpc_sgft.storage.metrics import progress


def test_explored_episodes_are_those_of_pretraining_and_follow_the_seed() -> None:
    cfg, other = compose("deploy", [], []), compose("deploy", ["seed=1"], [])
    agent, _ = build.load_agent(cfg)
    weights = {k: v.clone() for k, v in agent.model.state_dict().items()}
    steps = explored(cfg, agent.model, 6)
    assert steps.shape == (6, 40) and steps["observation"].shape[-1] == agent.model.obs_dim
    assert steps["next", "success"].any(), "the shipped policy can push"
    assert torch.equal(explored(cfg, agent.model, 6)["action"], steps["action"])
    assert not torch.equal(explored(other, agent.model, 6)["action"], steps["action"])
    towel = compose("deploy", ["task=push_towel", "gap=push_towel_real", "task.env.episode_steps=30"], [])
    assert torch.equal(explored(towel, agent.model, 6)["action"], steps["action"]), "its agents are of push"
    shorter = compose("deploy", ["task.env.episode_steps=30"], ["task.env.episode_steps=30"])
    assert explored(shorter, agent.model, 6).shape == (6, 30)
    with pytest.raises(UserError, match="obs_dim"):
        explored(compose("deploy", ["task.history=1"], ["task.history=1"]), agent.model, 6)
    assert all(torch.equal(v, weights[k]) for k, v in agent.model.state_dict().items())


@pytest.mark.parametrize("quiet", [True, False])
def test_a_bar_shows_how_far_the_simulated_episodes_are(quiet: bool, capsys, monkeypatch) -> None:
    bars = []
    monkeypatch.setattr(explore, "progress", lambda *given, **named: bars.append(progress(*given, **named)) or bars[-1])
    cfg = compose("deploy", [f"quiet={quiet}"], [])
    explored(cfg, build.load_agent(cfg)[0].model, 2)
    assert ("simulate" in capsys.readouterr().err) is not quiet
    assert quiet or bars[0].n == bars[0].total == 40, "every step counts"
