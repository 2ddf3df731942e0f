"""Implicit Q-learning: expectiles by hand, and choices whose best is known."""

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning.actor_critic import Transitions, of_slices
from mpc_sgft.learning.implicit_q import check_implicit, expectile_loss, fit_implicit
from mpc_sgft.learning.losses import two_hot_loss
from mpc_sgft.learning.slices import to_slices
from tests.mpc_sgft.learning.agents import changed, make_agent, make_batch, parts


def trained(**changes):
    agent = make_agent(sizes={"dropout": 0.0}, **changes)
    heads = ("q_ensemble", "value_head", "policy_head")
    agent.train_only(heads, lr=3e-3, policy_lr=3e-3, following=("target_q",))
    return agent


def test_the_loss_is_least_at_the_expectile() -> None:
    """Of 0 and 1 the tau-expectile is tau: tau (1 - m) = (1 - tau) m."""
    targets, guesses = torch.tensor([0.0, 1.0]), torch.linspace(0, 1, 101)
    loss = expectile_loss(targets - guesses[:, None], 0.8).sum(1)
    assert guesses[loss.argmin()] == pytest.approx(0.8)
    assert_close(expectile_loss(torch.tensor([2.0, -2.0]), 0.7), torch.tensor([2.8, 1.2]))


def test_the_policy_takes_the_better_of_two_actions_and_v_comes_close_to_its_worth() -> None:
    """In every state one of two actions was taken; one is worth 2, the other 0, and the world ends."""
    agent = trained(target_rate=0.1)
    before, better = parts(agent), torch.tensor([0.6, -0.4])
    generator = torch.Generator().manual_seed(0)
    z = agent.model.encode(torch.randn(256, 6, generator=generator)).detach()
    for _ in range(400):
        good = torch.rand(256, 1, generator=generator) < 0.3
        action = torch.where(good, better, -better)
        ended = torch.ones(256, dtype=torch.bool)
        found = Transitions(z, action, 2.0 * good.squeeze(1), z, ended)
        fit_implicit(agent, found, expectile=0.9, temperature=0.3)
    with torch.no_grad():
        chosen, value = agent.model.policy_prior(z, None), agent.model.terminal_value(z)
    assert (chosen - better).abs().max() < 0.1
    # of 0 in 7 and 2 in 3 of 10 cases the 0.9-expectile m has 0.3 x 0.9 (2 - m) = 0.7 x 0.1 m
    assert_close(value, torch.full((256,), 0.54 / 0.34), atol=0.15, rtol=0)
    assert changed(before, parts(agent)) == {"q_ensemble", "value_head", "target_q", "policy_head"}


@pytest.mark.parametrize("goes_on", [True, False])
def test_what_goes_on_is_worth_v_of_where_it_leads(goes_on: bool) -> None:
    agent = trained()
    with torch.no_grad():
        agent.model.value_head[-1].weight.normal_(std=0.3)
        found = of_slices(agent.model, to_slices(make_batch(), agent.device))
        found = found._replace(ended=torch.full_like(found.ended, not goes_on))
        later = 0.9 * agent.model.terminal_value(found.next_z) if goes_on else torch.zeros(len(found.z))
        logits = agent.model.q_logits(found.z, found.action)
        goal = agent.model.two_hot.encode(found.reward + later).expand_as(logits)
        expected = two_hot_loss(logits, goal).mean()
    assert (later.std() > 0.1) == goes_on
    assert_close(fit_implicit(agent, found, expectile=0.7, temperature=1.0)["q_loss"].detach(), expected)


@pytest.mark.parametrize("expectile, temperature", [(0.5, 1.0), (1.0, 1.0), (0.7, 0.0)])
def test_numbers_out_of_range_are_refused(expectile: float, temperature: float) -> None:
    with pytest.raises(ValueError, match="must"):
        check_implicit(expectile, temperature)
