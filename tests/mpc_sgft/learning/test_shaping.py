"""Shaping telescopes; the audit finds the known answer of a hand-made model."""

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning.shaping import improvable, shape_reward


def test_shaped_rewards_telescope():
    steps, discount = 5, 0.9
    reward, value = torch.randn(steps, dtype=torch.float64), torch.randn(steps + 1, dtype=torch.float64)
    shaped = shape_reward(reward, value[:-1], value[1:], torch.zeros(steps, dtype=torch.bool), discount)
    weights = discount ** torch.arange(steps, dtype=reward.dtype)  # of whole numbers they would be float32
    h_step_return = (weights * reward).sum() + discount**steps * value[-1]
    assert_close((weights * shaped).sum(), h_step_return - value[0])


def test_a_terminal_state_has_no_potential_and_a_truncated_one_has():
    one = torch.ones(2)
    shaped = shape_reward(one, 2 * one, 10 * one, torch.tensor([True, False]), 0.5)
    assert_close(shaped, torch.tensor([-1.0, 4.0]))


class Line:
    """State x on a line, x' = x + 0.1 a, V = x: the best action is 1 and the margin is known in closed form."""

    value_range = 1.0

    def next(self, z, action):
        return z + 0.1 * action

    def reward(self, z, action, next_z):
        return next_z.squeeze(-1)

    def terminal_value(self, z):
        return z.squeeze(-1)

    def policy_prior(self, z, noise):
        return torch.zeros_like(z) if noise is None else torch.tanh(0.1 * noise)


def audit(x, seed=0, **changes):
    generator = torch.Generator().manual_seed(seed)
    return improvable(Line(), x, **(dict(action_dim=1, discount=0.9, generator=generator) | changes))


def test_margin_of_a_line_is_the_one_by_hand():
    x = torch.tensor([[-0.1], [-0.3], [0.5]])
    found = audit(x)
    exact = 1.9 * (x.squeeze(1) + 0.1) - x.squeeze(1)  # 0.1, -0.08, 0.64: arriving pays, too
    assert_close(found.margin, exact, rtol=0, atol=4e-3)
    assert found.share == pytest.approx(2 / 3)
    assert_close(found.action, torch.ones(3, 1), rtol=0, atol=0.02)
    assert (found.margin <= exact + 1e-6).all()  # a lower bound: never claims what is not there


class Peak(Line):
    """V = 1 - (x - 0.0337)^2 from x = 0: the best action is 0.337, inside the box, so refining pays."""

    def reward(self, z, action, next_z):
        return torch.zeros_like(next_z).squeeze(-1)

    def terminal_value(self, z):
        return 1 - (z.squeeze(-1) - 0.0337) ** 2


def test_refinement_finds_an_inner_optimum():
    model, x = Peak(), torch.zeros(20, 1)

    def miss(refinements):
        generator = torch.Generator().manual_seed(1)
        found = improvable(
            model,
            x,
            action_dim=1,
            discount=1.0,
            generator=generator,
            num_prior=0,
            num_uniform=8,
            refinements=refinements,
        )
        return (found.action - 0.337).abs().mean()

    assert miss(6) < 0.2 * miss(0)
    assert miss(6) < 0.03


def test_the_same_generator_gives_the_same_audit():
    x = torch.rand(9, 1)
    assert torch.equal(audit(x, seed=3).margin, audit(x, seed=3).margin)


def test_shapes_that_do_not_agree_are_refused():
    with pytest.raises(ValueError, match=r"\[M, D\]"):
        audit(torch.zeros(3))
