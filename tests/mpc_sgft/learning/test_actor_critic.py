"""Soft actor-critic on latents: hand-made transitions, and a problem whose solution is known."""

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning.actor_critic import (
    Transitions,
    branches,
    fit_soft,
    forget_critics,
    guided,
    joined,
    of_slices,
    shaped,
)
from mpc_sgft.learning.slices import to_slices
from mpc_sgft.methods.pbrs import PBRS
from mpc_sgft.methods.sgft_sac import SGFTSAC
from tests.mpc_sgft.learning.agents import SENSED, changed, make_agent, make_batch, parts


def trained(**sizes):
    agent = make_agent(sizes={"dropout": 0.0, **sizes})
    agent.train_only(("q_ensemble", "policy_head"), lr=3e-3, policy_lr=3e-3, following=("target_q",))
    return agent


def test_slices_become_their_steps_and_guidance_ends_each_slice():
    agent, batch = make_agent(), make_batch(batch=2, steps=3)
    batch["next", "terminated"][1, 0] = True
    found = of_slices(agent.model, to_slices(batch, agent.device))
    assert found.z.shape == found.next_z.shape == (6, 16) and found.action.shape == (6, 2)
    assert_close(found.next_z[:4], found.z[2:])  # time first: two slices side by side
    assert_close(found.reward, batch["next", "reward"].squeeze(-1).T.flatten())
    assert found.ended.tolist() == [False, True, False, False, False, False]
    assert guided(agent.model, found, 0.9, 3).ended.tolist() == [False, True, False, False, True, True]
    assert found.ended.sum() == 1  # what was seen is left as it was


def test_rewards_of_a_guided_slice_add_up_to_the_objective_of_sgft_with_its_last_value():
    agent = make_agent()
    with torch.no_grad():
        agent.model.value_head[-1].weight.normal_(std=0.3)
    found = of_slices(agent.model, to_slices(make_batch(batch=1, steps=3), agent.device))
    value = agent.model.terminal_value
    rewards, weights = guided(agent.model, found, 0.9, 3).reward, 0.9 ** torch.arange(4.0)
    whole = weights[:3] @ found.reward + weights[3] * value(found.next_z[-1]) - value(found.z[0])
    assert value(torch.cat([found.z, found.next_z])).std() > 0.01
    assert_close(weights[:3] @ rewards, whole.detach())
    assert_close(shaped(agent.model, found, 0.9).reward, rewards)


def test_branches_follow_the_policy_in_the_dynamics():
    model = make_agent().model
    z, noise = model.encode(torch.randn(4, 6)).detach(), torch.randn(2, 4, 2)
    found = branches(model, z, noise)
    assert_close(found.z[:4], z), assert_close(found.z[4:], found.next_z[:4])
    assert_close(found.action[4:], model.policy(found.z[4:], noise[1])[0])
    assert_close(found.next_z, model.next(found.z, found.action))
    assert not found.ended.any() and len(joined(found, found).z) == 16


def test_the_policy_finds_the_best_action_of_a_single_step_and_the_critics_its_worth():
    """The reward is 1 - |a - (0.5, -0.3)|^2 in every state, and the world ends."""
    agent = trained()
    forget_critics(agent.model)
    assert agent.model.q(torch.randn(3, 16), torch.zeros(3, 2)).abs().max() < 1e-6
    before, best = parts(agent), torch.tensor([0.5, -0.3])
    generator = torch.Generator().manual_seed(0)
    z = agent.model.encode(torch.randn(256, 6, generator=generator)).detach()
    for _ in range(400):
        action = 2 * torch.rand(256, 2, generator=generator) - 1
        reward = 1 - (action - best).square().sum(1)
        fit_soft(agent, Transitions(z, action, reward, z, torch.ones(256) > 0), entropy_coef=1e-3)
    with torch.no_grad():
        action = agent.model.policy_prior(z, None)
        assert (action - best).abs().max() < 0.1
        assert (agent.model.q(z, best.expand(256, 2)) - 1).abs().max() < 0.1
    assert changed(before, parts(agent)) == {"q_ensemble", "target_q", "policy_head"}


def test_what_goes_on_is_worth_the_lesser_critic_and_the_entropy_of_what_follows():
    alpha = 0.5
    for goes_on in (True, False):
        agent = make_agent(sizes={"dropout": 0.0})
        agent.update(make_batch())  # critics that differ
        agent.train_only(("q_ensemble", "policy_head"), lr=3e-3, policy_lr=3e-3, following=("target_q",))
        found = of_slices(agent.model, to_slices(make_batch(terminated=False), agent.device))
        found = found._replace(ended=torch.full_like(found.ended, not goes_on))
        again = torch.Generator()
        again.set_state(agent.generator.get_state())
        noise = torch.randn(len(found.z), 2, generator=again)
        with torch.no_grad():
            action, log_prob = agent.model.policy(found.next_z, noise)
            q = agent.model.q(found.next_z, action, target=True)
        assert (q[0] > q[1]).any() and (q[0] < q[1]).any()
        later = 0.9 * (q.amin(0) - alpha * log_prob) if goes_on else 0
        expected = float((found.reward + later).mean())
        assert abs(float(fit_soft(agent, found, entropy_coef=alpha)["target_value"]) - expected) < 1e-5


def test_entropy_grows_where_the_critics_say_nothing():
    agent = trained()
    forget_critics(agent.model)
    found = of_slices(agent.model, to_slices(make_batch(), agent.device))
    found = found._replace(reward=torch.zeros_like(found.reward), ended=torch.ones_like(found.ended))
    entropies = [float(fit_soft(agent, found, entropy_coef=0.5)["entropy"].detach()) for _ in range(20)]
    assert entropies[-1] > entropies[0] + 0.1


@pytest.mark.parametrize("name", ["pbrs", "sgft_sac"])
def test_methods_learn_from_shaped_rewards_with_the_value_of_what_follows(name):
    agent = make_agent(sizes={"dropout": 0.0})
    with torch.no_grad():
        agent.model.value_head[-1].weight.normal_(std=0.1)
    batch = make_batch(batch=64, steps=1, terminated=True)
    batch["next", "terminated"][1:] = False
    numbers = dict(lr=1e-3, policy_lr=1e-3, entropy_coef=0.0, updates=1, slice_len=1, action_noise=0.0)
    method = PBRS(**numbers) if name == "pbrs" else SGFTSAC(**numbers, branches=0, rho=0.5)
    method.take_over(agent, SENSED)
    z, next_z = (agent.model.encode(x[:, 0]) for x in (batch["observation"], batch["next", "observation"]))
    value, later = (agent.model.terminal_value(x).detach() for x in (z, next_z))
    later[0] = 0  # it has terminated
    expected = batch["next", "reward"].flatten() + 0.9 * later - value
    metrics = method.update(agent, batch, starts=torch.zeros(1, 6))
    assert later.std() > 0.1 and abs(metrics["target_value"] - float(expected.mean())) < 1e-5  # new critics add nothing
