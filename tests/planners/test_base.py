"""The objective: by hand, telescoping, and what goes wrong loudly."""

from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from planners.base import (
    FiniteChecks,
    check_finite,
    h_step_return,
    imagine,
    imagine_policy,
    imagined_return,
    sgft_objective,
)


def test_h_step_return_by_hand() -> None:
    model = SimpleNamespace(
        next=lambda z, a: 2 * z + a,
        reward=lambda z, a, next_z: (z + 10 * a + 100 * next_z).squeeze(-1),
        terminal_value=lambda z: z.squeeze(-1) ** 2,
    )
    z, actions = torch.tensor([[1.0]]), torch.tensor([[[0.5], [-1.0]]])  # latents 1 -> 2.5 -> 4
    # r_0 = 1 + 5 + 250 = 256, r_1 = 2.5 - 10 + 400 = 392.5, V = 16: 256 + 0.5 * 392.5 + 0.25 * 16
    assert_close(h_step_return(model, z, actions, 0.5), torch.tensor([456.25]))
    assert_close(h_step_return(model, z, actions, 0.0), torch.tensor([256.0]))
    assert_close(h_step_return(model, z, actions, 1.0), torch.tensor([664.5]))
    assert_close(sgft_objective(model, z, actions, 0.5), torch.tensor([455.25]))  # less V(z_0) = 1


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("horizon", [1, 4, 16])
def test_shaped_rewards_telescope(random_model, seed: int, horizon: int) -> None:
    model, discount = random_model(seed, offset=3.0), 0.95
    z, actions = torch.randn(3, 7, 6), torch.rand(3, 7, horizon, 2) * 2 - 1
    left = torch.zeros(3, 7)
    now = z
    for t, action in enumerate(actions.unbind(-2)):
        after = model.next(now, action)
        reward = model.reward(now, action, after)
        left += discount**t * (reward + discount * model.terminal_value(after) - model.terminal_value(now))
        now = after
    assert_close(sgft_objective(model, z, actions, discount), left, atol=1e-5, rtol=0)


def test_one_latent_serves_all_plans_of_an_environment(random_model) -> None:
    model, z, actions = random_model(), torch.randn(3, 6), torch.rand(3, 7, 4, 2)
    repeated = z.unsqueeze(1).expand(-1, 7, -1)
    for objective in (h_step_return, sgft_objective):
        assert_close(objective(model, z, actions, 0.9), objective(model, repeated, actions, 0.9))
        assert_close(objective(model, z[1], actions[1], 0.9), objective(model, z, actions, 0.9)[1])


def test_following_the_policy_is_imagining_its_actions(random_model) -> None:
    model, z, noise = random_model(), torch.randn(5, 6), torch.randn(5, 3, 2)
    for drawn in (noise, None):
        latents, actions = imagine_policy(model, z, drawn, 3)
        assert_close(latents, imagine(model, z, actions))
        assert_close(imagined_return(model, latents, actions, 0.9), h_step_return(model, z, actions, 0.9))
    assert_close(actions[:, 1], model.policy_prior(latents[:, 1], None))


def test_the_return_can_be_trained_through(random_model) -> None:
    actions = torch.zeros(1, 4, 2, requires_grad=True)
    h_step_return(random_model(), torch.randn(1, 6), actions, 0.9).sum().backward()
    assert actions.grad is not None and (actions.grad[0].abs().sum(-1) > 0).all()  # every step matters


@pytest.mark.parametrize("discount", [-0.1, 1.01, float("nan")])
def test_a_discount_outside_0_1_is_refused(random_model, discount: float) -> None:
    with pytest.raises(ValueError, match=r"discount=.* is outside \[0, 1\]"):
        h_step_return(random_model(), torch.zeros(1, 6), torch.zeros(1, 2, 2), discount)


@pytest.mark.parametrize("shape", [(2, 6), (3, 6, 6), (6,)])
def test_latents_that_do_not_go_with_the_plans_are_refused(random_model, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="do not go with plans"):
        h_step_return(random_model(), torch.zeros(shape), torch.zeros(3, 5, 4, 2), 0.9)


def test_the_first_check_that_failed_is_told_with_its_environments() -> None:
    def checked(x: torch.Tensor) -> None:
        checks = FiniteChecks()
        checks.note("latents", torch.zeros(12, 2))
        checks.note("candidate values", x)
        checks.note("planned actions", torch.full((12, 3, 2), float("nan")) if not x.isfinite().all() else x)
        check_finite("MPPI", checks.names, checks.stacked())

    x = torch.zeros(12, 2)
    checked(x)
    x[3, 1] = float("inf")
    with pytest.raises(FloatingPointError, match=r"^MPPI: candidate values are non-finite \(env 3\)\.$"):
        checked(x)
    with pytest.raises(FloatingPointError, match=r"values are .* \(env 0, 1, 2, 3, 4, 5, 6, 7, \.\.\."):
        checked(torch.full((12, 2), float("nan")))
