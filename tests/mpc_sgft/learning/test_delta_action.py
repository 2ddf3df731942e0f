"""Delta actions: a machine that does something else with its commands is found, and the policy makes up for it."""

import torch
from torch.testing import assert_close

from mpc_sgft.learning.delta_action import DeltaAction
from mpc_sgft.learning.slices import Slices
from mpc_sgft.methods.asap import ASAP
from tests.mpc_sgft.learning.agents import SENSED, changed, make_agent, make_batch, parts

MEMORY = {"memory_dim": 4, "obs_dim": 10, "dropout": 0.0}  # two past commands
NUMBERS = dict(lr=1e-3, policy_lr=1e-3, entropy_coef=0.0, rho=1.0, shrink=0.0, steps=2, simulated_episodes=1)
NUMBERS |= dict(updates=1, slice_len=3, action_noise=0.0)


def test_it_starts_as_the_simulator_and_remembers_commands_as_they_were_given() -> None:
    model = make_agent(MEMORY).model
    corrected = DeltaAction(model.dynamics, model.latent_dim, 2, lr=1e-3)
    z, action = model.encode(torch.randn(5, 10)), torch.rand(5, 2)
    assert_close(corrected(z, action), model.next(z, action))
    with torch.no_grad():
        corrected.delta[-1].bias.fill_(0.3)
    moved = corrected(z, action)
    assert_close(moved[:, :16], model.next(z, action + 0.3)[:, :16])
    assert_close(moved[:, 16:], torch.cat([action, z[:, 16:18]], -1))
    assert set(corrected.state_dict()) == {f"delta.{name}" for name in corrected.delta.state_dict()}


def test_the_correction_is_found_through_the_simulator() -> None:
    """A machine that does half of what it is told, and 0.2 more: delta(a) = -a / 2 + 0.2."""
    torch.manual_seed(0)
    agent = make_agent(MEMORY)
    for seed in range(50):
        agent.model.normalizer.update(torch.randn(64, 10, generator=torch.Generator().manual_seed(seed)))
    model = agent.model
    corrected = DeltaAction(model.dynamics, model.latent_dim, 2, lr=3e-3)
    generator = torch.Generator().manual_seed(0)
    start = model.encode(torch.randn(256, 10, generator=generator)).detach()
    for _ in range(400):
        action = 2 * torch.rand(1, 256, 2, generator=generator) - 1
        with torch.no_grad():
            following = model.next(start, 0.5 * action[0] + 0.2)
            following[:, 16:18] = action[0]
        nothing = torch.zeros(1, 256)
        metrics = corrected.fit(
            Slices(torch.zeros(2, 256, 10), action, nothing, nothing > 0),
            torch.stack([start, following]),
            rho=1.0,
            shrink=0.0,
        )
    assert metrics["consistency_loss"] < 1e-5
    asked = torch.tensor([[0.8, -0.8], [-0.4, 0.4]])
    found = corrected.delta(torch.cat([start[:2], asked], -1)).detach()
    assert_close(found, -0.5 * asked + 0.2, atol=0.1, rtol=0)


def test_only_real_steps_correct_and_the_dynamics_stay() -> None:
    agent = make_agent(sizes={"dropout": 0.0})
    method = ASAP(**NUMBERS)
    method.take_over(agent, SENSED)
    before, batch = parts(agent), make_batch(batch=8)
    again = batch.clone()
    again["next", "observation"][4:] += 1.0  # of the simulated half
    for _ in range(2):
        method.update(agent, batch, starts=torch.zeros(1, 6))
    assert changed(before, parts(agent)) == {"q_ensemble", "target_q", "policy_head"}
    deltas = []
    for data in (batch, again):
        agent = make_agent(sizes={"dropout": 0.0})
        method = ASAP(**NUMBERS)
        torch.manual_seed(0)
        method.take_over(agent, SENSED)
        method.update(agent, data, starts=torch.zeros(1, 6))
        deltas.append(method.corrected.delta[-1].weight.detach().clone())
    assert deltas[0].abs().max() > 0 and torch.equal(*deltas)
