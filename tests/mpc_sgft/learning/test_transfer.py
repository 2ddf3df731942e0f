"""What trains and what acts: the gate, the average, a latent that carries commands, and the map of them."""

import math

import pytest
import torch

from mpc_sgft.learning.choice import Verdict, begins
from mpc_sgft.learning.transfer import mean_error, open_loop_error
from mpc_sgft.learning.world_model import WorldModel
from tests.mpc_sgft.learning.agents import SENSED, SIZES
from tests.mpc_sgft.learning.transfers import MEMORY, make_agent, make_sgft, rollout, same, transfer


def test_nothing_acts_before_it_predicted_an_unseen_rollout_better():
    t = transfer(updates=60)
    data = rollout(t.pretrained)
    t.learn(data)
    assert same(t.acting, t.pretrained) and not same(t.agent.model, t.pretrained)
    t.learn(data)  # the same world again: what was learned predicts it better
    assert t.verdicts[-1].fine_tuned < 0.9 * t.verdicts[-1].pretrained
    assert t.verdicts[-1].accepted and same(t.acting, t.agent.model)


@pytest.mark.parametrize(("share", "acts", "goes_on"), [(0.85, False, True), (0.75, True, True), (1.1, False, False)])
def test_who_acts_goes_on_while_it_is_better_at_all(share: float, acts: bool, goes_on: bool, monkeypatch):
    """The margin of 0.8 is for who does not act yet; errors of later rollouts are set here."""
    for before, wanted in ((False, acts), (True, goes_on)):
        t = transfer(updates=1, margin=0.8)
        t.verdicts = [Verdict(1.0, 1.0, False), Verdict(1.0, share, before)]
        monkeypatch.setattr(
            "mpc_sgft.learning.transfer.open_loop_error",
            lambda model, *_, t=t: torch.full((2, 2), 1.0 if model is t.pretrained else share),
        )
        t.learn(rollout(t.pretrained))
        assert t.verdicts[-1].accepted is wanted
        assert same(t.acting, t.averaged.model if wanted else t.pretrained)


@pytest.mark.parametrize(("odd", "accepted"), [(3.0, True), (10.0, False)])
def test_one_odd_rollout_does_not_shut_the_gate(odd, accepted):
    """0.5^4 * 3 = 0.19 < 0.9^5 = 0.59 < 0.5^4 * 10, although the sums would say 5 > 0.9 * 5."""
    errors = [(error, 1.0) for error in (0.5, 0.5, 0.5, 0.5, odd)]
    assert begins(errors, acts=False, margin=0.9) is accepted


def test_without_the_gate_what_trains_acts_at_once():
    t = transfer(gate=False)
    t.learn(rollout(t.pretrained))
    assert same(t.acting, t.agent.model) and not same(t.acting, t.pretrained)


def test_what_acts_is_the_average_of_the_last_updates_with_a_share_of_the_policy_s_change():
    decay, share, updates = 0.5, 0.25, 3
    t = transfer(gate=False, updates=updates, of_method={"average_decay": decay, "policy_share": share})
    seen, follow = [], t.averaged.follow

    def note(model: WorldModel) -> None:
        seen.append([p.detach().clone() for p in model.parameters()])
        follow(model)

    t.averaged.follow = note
    t.learn(rollout(t.pretrained))
    assert len(seen) == updates
    for k, (name, acts) in enumerate(t.acting.named_parameters()):
        average = 0.25 * seen[0][k] + 0.25 * seen[1][k] + 0.5 * seen[2][k]
        before = t.pretrained.get_parameter(name)
        wanted = before + share * (average - before) if name.startswith("policy_head.") else average
        assert torch.allclose(acts, wanted, atol=1e-6), name
    assert not same(t.acting, t.averaged.model)


def test_a_saved_transfer_goes_on_with_the_same_numbers():
    once, twice = (transfer(of_method={"average_decay": 0.9, "policy_share": 0.5}) for _ in range(2))
    for t in (once, twice):
        t.learn(rollout(t.pretrained, seed=1))
    again = transfer(of_method={"average_decay": 0.9, "policy_share": 0.5})
    again.load_state_dict(twice.state_dict())
    once.learn(rollout(once.pretrained, seed=2))
    again.learn(rollout(again.pretrained, seed=2))
    assert same(once.agent.model, again.agent.model) and once.verdicts == again.verdicts
    assert same(once.averaged.model, again.averaged.model) and same(once.acting, again.acting)


def test_an_episode_that_ended_early_is_not_imagined_beyond():
    model = make_agent().model
    parts = [rollout(model, 6, seed=1), rollout(model, 4, seed=2), rollout(model, 1, seed=3)]
    parts[1]["next", "invalid"][-1] = True
    alone = [open_loop_error(model, steps, 2).nanmean().item() for steps in (parts[0], parts[1][:-1])]
    row = torch.cat(parts).unsqueeze(0)
    assert mean_error(model, row, 2) == pytest.approx(math.sqrt(math.prod(alone)))


def test_open_loop_error_by_hand():
    t = transfer()
    data, model = rollout(t.pretrained, steps=4), t.pretrained
    error = open_loop_error(model, data, 3)
    z = model.encode(data["observation"][1:2])
    for k in (1, 2):
        z = model.next(z, data["action"][k : k + 1])
    expected = (z - model.encode(data["next", "observation"][2:3])).square().mean()
    assert torch.isclose(error[1, 1], expected)
    assert error[3, 1:].isnan().all() and not error[:2].isnan().any()
    data["next", "invalid"][-1] = True  # nothing was seen after it
    failed = open_loop_error(model, data, 3)
    torch.testing.assert_close(failed[:3], open_loop_error(model, data[:3], 3), equal_nan=True)
    assert failed.shape == error.shape and failed[3].isnan().all() and failed[2, 1:].isnan().all()
    data["next", "invalid"][:] = True
    assert open_loop_error(model, data, 3).isnan().all()


def test_the_latent_carries_past_commands_exactly():
    model = WorldModel(**(SIZES | MEMORY))
    observation = torch.randn(5, 6)
    z = model.encode(observation)
    assert torch.equal(z[:, -2:], observation[:, -2:])
    action = torch.rand(5, 1)
    assert torch.equal(model.next(z, action)[:, -2:], torch.cat([action, observation[:, -2:-1]], 1))


def test_a_command_map_starts_as_the_identity_and_recovers_gain_and_delay():
    torch.manual_seed(0)
    model = WorldModel(**(SIZES | MEMORY))
    truth = WorldModel(**(SIZES | MEMORY))
    truth.load_state_dict(model.state_dict())
    z, action = model.encode(torch.randn(256, 6)), 2 * torch.rand(256, 1) - 1
    before = model.next(z, action)
    model.add_command_map()
    truth.add_command_map()
    assert torch.equal(model.next(z, action), before)
    with torch.no_grad():  # 0.3 of this command, 0.5 of the one before, and a drift
        truth.dynamics.command.weight.copy_(torch.tensor([[0.3, 0.5, 0.0]]))
        truth.dynamics.command.bias.fill_(0.1)
        target = truth.next(z, action)
    optimizer = torch.optim.Adam(model.dynamics.command.parameters(), lr=2e-2)
    for _ in range(400):
        loss = (model.next(z.detach(), action) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert torch.allclose(model.dynamics.command.weight, torch.tensor([[0.3, 0.5, 0.0]]), atol=0.02)
    assert model.dynamics.command.bias.item() == pytest.approx(0.1, abs=0.02)


def test_with_a_command_map_everything_else_stays_frozen():
    agent = make_agent(sizes=MEMORY)
    method = make_sgft(command_map=True, anchor=0.1)
    method.take_over(agent, SENSED)
    before, frozen = agent.model.dynamics.command.weight.clone(), agent.frozen_hash()
    method.update(agent, rollout(agent.model, 6)[:4].unflatten(0, (2, 2)), starts=torch.zeros(1, agent.model.obs_dim))
    assert agent.frozen_hash() == frozen
    assert not torch.equal(before, agent.model.dynamics.command.weight)
