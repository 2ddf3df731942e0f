"""Density ratios whose truth is known, and what is believed of simulated transitions."""

import torch
from torch.testing import assert_close

from mpc_sgft.learning.actor_critic import Transitions, fit_soft, forget_critics, of_slices
from mpc_sgft.learning.dynamics_gap import DynamicsGap
from mpc_sgft.learning.slices import to_slices
from mpc_sgft.methods.h2o import H2O
from tests.mpc_sgft.learning.agents import SENSED, changed, make_agent, make_batch, parts

NUMBERS = dict(lr=1e-3, policy_lr=1e-3, entropy_coef=0.0, simulated_episodes=1, updates=1, slice_len=3, action_noise=0)


def moved(generator: torch.Generator, shift: float, where: float) -> Transitions:
    """z' = z + shift + noise of spread 1, from starts around `where`."""
    z = torch.randn(256, 1, generator=generator) + where
    following = z + shift + torch.randn(256, 1, generator=generator)
    nothing = torch.zeros(256)
    return Transitions(z, torch.zeros(256, 1), nothing, following, nothing > 0)


def test_the_ratio_is_that_of_the_dynamics_wherever_the_data_lie() -> None:
    """N(1, 1) over N(-1, 1) at a step d is exp(2 d); that simulation starts elsewhere changes nothing."""
    torch.manual_seed(0)
    gap, generator = DynamicsGap(1, 1, lr=3e-3, blur=0.0), torch.Generator().manual_seed(0)
    real = torch.arange(512) < 256
    for _ in range(800):
        pair = (moved(generator, 1.0, 0.0), moved(generator, -1.0, 1.5))
        gap.fit(Transitions(*(torch.cat(x) for x in zip(*pair, strict=True))), real)
    step = torch.tensor([[-1.0], [-0.5], [0.0], [0.5], [1.0]])
    z = torch.zeros(5, 1)  # where reality has been more often: log-odds of 1.1 before any step is seen
    asked = Transitions(z, torch.zeros(5, 1), torch.zeros(5), z + step, torch.zeros(5) > 0)
    assert_close(gap.log_ratio(asked), 2 * step.squeeze(1), atol=0.5, rtol=0)


def test_a_weight_of_nothing_leaves_a_transition_out() -> None:
    critics = []
    for kept in (slice(None), slice(0, 48)):
        agent = make_agent(sizes={"dropout": 0.0})
        agent.train_only(("q_ensemble", "policy_head"), lr=3e-3, policy_lr=3e-3, following=("target_q",))
        with torch.no_grad():
            for critic in agent.model.q_ensemble:
                critic[-1].weight.normal_(std=0.3, generator=torch.Generator().manual_seed(0))
        whole = of_slices(agent.model, to_slices(make_batch(), agent.device))
        whole = whole._replace(ended=torch.ones_like(whole.ended))  # no action is drawn for the target then
        weight = (torch.arange(96) < 48).float()
        some = Transitions(*(x[kept] for x in whole))
        loss = fit_soft(agent, some, entropy_coef=0.0, weight=weight[kept])["q_loss"].detach()
        critics.append((float(loss) * len(some.z), agent.model.q_ensemble[0][-1].weight.detach().clone()))
    (one, weights), (other, same) = critics
    assert abs(one - other) < 1e-2
    assert_close(weights, same, atol=3e-4, rtol=0)  # Adam's step is 3e-3, whichever way


def test_what_simulation_promises_is_doubted_where_its_dynamics_differ() -> None:
    """Reality pays nothing and moves otherwise; in simulation the same actions pay 1."""
    worth = {}
    for penalty in (0.0, 0.1):
        agent = make_agent(sizes={"dropout": 0.0})
        method = H2O(**NUMBERS, penalty=penalty)
        method.take_over(agent, SENSED)
        forget_critics(agent.model)
        before = parts(agent)
        for seed in range(150):
            batch = make_batch(seed, batch=64, steps=1, reward=0.0)
            batch["next", "reward"][32:] = 1.0
            batch["action"][32:] = (batch["action"][32:] + 0.5).clamp_max(1)
            batch["next", "observation"][32:] += 3.0
            metrics = method.update(agent, batch, starts=torch.zeros(1, 6))
        assert changed(before, parts(agent)) == {"q_ensemble", "target_q", "policy_head"}
        assert metrics["simulated_weight"] < 0.2, "that these steps are not of reality is easily seen"
        found = of_slices(agent.model, to_slices(batch, agent.device))
        with torch.no_grad():
            real, simulated = agent.model.q(found.z, found.action).mean(0).split(32)
        worth[penalty] = float(simulated.mean() - real.mean())
    assert worth[0.1] < worth[0.0] - 0.001


def test_what_the_classifiers_learned_is_saved() -> None:
    methods = []
    for _ in range(2):
        agent = make_agent(sizes={"dropout": 0.0})
        methods.append((H2O(**NUMBERS, penalty=0.1), agent))
        methods[-1][0].take_over(agent, SENSED)
    (one, agent), (other, _) = methods
    one.update(agent, make_batch(), starts=torch.zeros(1, 6))
    other.load_state_dict(one.state_dict())
    found = of_slices(agent.model, to_slices(make_batch(1), agent.device))
    assert one.gap.log_ratio(found).abs().max() > 0
    assert torch.equal(other.gap.log_ratio(found), one.gap.log_ratio(found))
    assert other.gap.optimizer.state_dict()["state"]
