"""Losses by hand, and the transfer objective against the planner's own equation."""

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from mpc_sgft.learning import losses
from mpc_sgft.learning.layers import TwoHot
from mpc_sgft.learning.world_model import WorldModel
from planners.base import sgft_objective

SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)


def test_td_target_by_hand_terminated_and_truncated():
    reward = torch.tensor([[1.0, 1.0, 1.0]])
    terminated = torch.tensor([[False, True, False]])  # the third was truncated: only the clock ended it
    next_q = torch.tensor([[[10.0, 10.0, 30.0]], [[20.0, 20.0, 20.0]]])
    assert_close(losses.td_target(reward, terminated, next_q, 0.5), torch.tensor([[6.0, 1.0, 11.0]]))


def test_td_lambda_by_hand_and_its_ends():
    reward = torch.tensor([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]])
    terminated = torch.tensor([[False, False], [False, True], [False, False]])
    v = torch.tensor([[10.0, 10.0], [20.0, 20.0], [40.0, 40.0]])
    last = 4 + 0.5 * 40.0  # 24
    middle = 2 + 0.5 * (0.25 * 20 + 0.75 * last)  # 13.5
    first = 1 + 0.5 * (0.25 * 10 + 0.75 * middle), 1 + 0.5 * (0.25 * 10 + 0.75 * 2.0)  # the second one ended
    found = losses.td_target(reward, terminated, torch.stack([v, v + 1]), 0.5, td_lambda=0.75)
    assert_close(found, torch.tensor([first, (middle, 2.0), (last, last)]))
    whole = losses.td_target(reward, terminated, torch.stack([v, v]), 0.5, td_lambda=1.0)
    assert whole[0, 0] == 1 + 0.5 * (2 + 0.5 * last)  # rewards to the slice's end, and one value there
    one_step = losses.td_target(reward, terminated, torch.stack([v, v]), 0.5)
    assert_close(one_step, reward + 0.5 * torch.where(terminated, 0.0, v))


def test_a_terminal_state_is_worth_nothing_whatever_the_critic_says():
    q = torch.tensor([[[4.0, torch.nan]], [[8.0, torch.nan]]])
    assert_close(losses.value_target(q, torch.tensor([[False, True]])), torch.tensor([[6.0, 0.0]]))


def test_over_time_weighs_by_rho():
    loss = torch.tensor([[1.0, 3.0], [10.0, 10.0]])  # [T, B]
    assert losses.over_time(loss, 0.5).item() == pytest.approx((2.0 + 0.5 * 10.0) / 2)


def test_consistency_is_zero_on_equal_latents_and_never_trains_the_target():
    a, b = torch.randn(3, 4, 8, requires_grad=True), torch.randn(3, 4, 8, requires_grad=True)
    assert losses.consistency_loss(a, a).abs().max() == 0
    losses.consistency_loss(a, b).sum().backward()
    assert b.grad is None and a.grad is not None


def test_two_hot_loss_is_cross_entropy_and_smallest_at_the_target():
    two_hot = TwoHot(101, -10, 10)
    target = two_hot.encode(torch.tensor([[0.3, -5.0]]))
    logits = torch.randn(1, 2, 101)
    assert_close(losses.two_hot_loss(logits, target), -(target * logits.log_softmax(-1)).sum(-1))
    best = losses.two_hot_loss(target.clamp_min(1e-20).log(), target)
    assert (best < losses.two_hot_loss(logits, target)).all()


def test_policy_loss_by_hand():
    q, log_prob = torch.tensor([[[2.0]], [[4.0]]]), torch.tensor([[-1.0]])
    assert losses.policy_loss(q, log_prob, 0.1, 2.0).item() == pytest.approx(-0.1 - 1.5)


def test_entropy_coefficient_grows_while_entropy_is_below_its_target():
    for log_prob, sign in ((3.0, -1), (-3.0, 1)):  # target entropy -2: log pi 3 is too certain
        log_coef = torch.zeros((), requires_grad=True)
        losses.entropy_coef_loss(log_coef, torch.full((5,), log_prob), -2.0).backward()
        assert log_coef.grad.sign() == sign  # gradient descent goes the other way


def test_running_scale_is_the_5_to_95_percent_range_and_at_least_one():
    scale = losses.RunningScale(rate=1.0)
    assert scale.update(torch.linspace(0, 100, 1001)).item() == pytest.approx(90.0, rel=1e-3)
    assert scale.update(torch.zeros(10)).item() == 1.0
    slow = losses.RunningScale(rate=0.1)
    assert slow.update(torch.linspace(0, 100, 1001)).item() == pytest.approx(0.9 + 9.0, rel=1e-3)


def test_imagined_objective_equals_the_planners_objective_for_the_same_actions():
    torch.manual_seed(0)
    model = WorldModel(**SIZES)
    for head in (model.value_head, model.reward_head, model.policy_head):
        torch.nn.init.normal_(head[-1].weight, std=0.3)
    z, noise = model.encode(torch.randn(7, 6)).detach(), torch.randn(4, 7, 2)
    objective, log_prob = losses.imagined_objective(model, z, noise, 0.9)
    actions, at = [], z
    for step_noise in noise:
        actions.append(model.policy_prior(at, step_noise))
        at = model.next(at, actions[-1])
    expected = sgft_objective(model, z, torch.stack(actions, 1), 0.9)
    assert_close(objective, expected, rtol=1e-4, atol=1e-4)
    assert log_prob.shape == (7,)


def test_imagined_objective_teaches_the_policy_through_the_dynamics():
    """V rises along one latent group only; ascending the objective must move the imagined latent there."""
    torch.manual_seed(0)
    model = WorldModel(**SIZES)
    direction = torch.randn(16)
    model.terminal_value = lambda z: 10 * F.linear(z, direction)
    torch.nn.init.normal_(model.dynamics.base[-1].linear.weight)
    z = model.encode(torch.randn(64, 6)).detach()
    optimizer = torch.optim.Adam(model.policy_head.parameters(), lr=3e-3)
    generator, values = torch.Generator().manual_seed(0), []
    for _ in range(60):
        objective, _ = losses.imagined_objective(model, z, torch.randn(2, 64, 2, generator=generator), 0.99)
        values.append(objective.mean().item())
        optimizer.zero_grad()
        (-objective.mean()).backward(inputs=list(model.policy_head.parameters()))
        optimizer.step()
    assert values[-1] > values[0] + 0.1
    assert all(p.grad is None for p in model.dynamics.parameters())
