"""A search ends, where all plans are worth the same, at the action that the machine turns into nothing."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from planners.base import Plan, h_step_return
from planners.cem import CEM
from planners.mppi import MPPI
from planners.neutral import from_neutral, to_neutral

BOTH = pytest.mark.parametrize("kind", [MPPI, CEM])
SMALL = {"action_dim": 2, "num_candidates": 64, "num_prior": 8, "num_elites": 16, "iterations": 3}
NEUTRAL = torch.tensor([0.5, -0.25])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def drifting(random_model):
    """A model whose machine stands still at NEUTRAL."""
    model = random_model()
    model.neutral_action = lambda: NEUTRAL
    return model


def flat(model):
    """All plans are worth the same, up to noise that tells nothing; the prior pushes at the limits either way."""
    noise = seeded(7)
    model.reward = lambda z, action, next_z: 0.01 * torch.randn(action.shape[:-1], generator=noise)
    model.terminal_value = lambda z: torch.zeros(z.shape[:-1])
    model.policy_prior = lambda z, noise: torch.sign(torch.randn(*z.shape[:-1], 2, generator=seeded(1)))
    return model


def test_coordinates_by_hand() -> None:
    v = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0])
    assert_close(from_neutral(v, torch.tensor(0.5)), torch.tensor([-1.0, -0.25, 0.5, 0.75, 1.0]))
    for n in (-1.0, -0.4, 0.0, 0.7, 1.0):
        neutral, action = torch.tensor(n), torch.linspace(-1, 1, 9)
        assert_close(from_neutral(to_neutral(action, neutral), neutral), action)
        assert to_neutral(neutral, neutral) == 0
    assert torch.equal(from_neutral(v, None), v) and torch.equal(to_neutral(v, None), v)


@BOTH
def test_among_equal_plans_the_action_is_the_neutral_action(drifting, kind: type[MPPI] | type[CEM]) -> None:
    model, z, generator = flat(drifting), torch.randn(400, 6, generator=seeded(1)), seeded()
    plan = None
    for _ in range(3):  # it stays there through warm starts
        plan = kind(**SMALL).plan(model, z, plan, None, generator)
    assert_close(plan.action.median(0).values, NEUTRAL, atol=0.05, rtol=0)
    around_zero = kind(**SMALL, neutral=False).plan(model, z, None, None, generator)
    assert_close(around_zero.action.median(0).values, torch.zeros(2), atol=0.05, rtol=0)


@BOTH
@pytest.mark.parametrize("neutral", [None, torch.zeros(2)])
def test_a_machine_without_a_drift_is_planned_for_as_before(
    random_model, kind: type[MPPI] | type[CEM], neutral: Tensor | None
) -> None:
    model, z = random_model(), torch.randn(5, 6, generator=seeded(1))
    plain = kind(**SMALL).plan(model, z, None, None, seeded(), explore=True)
    model.neutral_action = lambda: neutral
    plans = [kind(**SMALL, neutral=on).plan(model, z, None, None, seeded(), explore=True) for on in (True, False)]
    for plan in plans:
        assert all(torch.equal(x, y) for x, y in zip(plan[:4], plain[:4], strict=True))


@BOTH
def test_plans_and_candidates_are_actions(drifting, kind: type[MPPI] | type[CEM]) -> None:
    """What comes back is what was imagined: in the units of actions, the prior's untouched."""
    z, asked, prior = torch.randn(3, 6, generator=seeded(1)), [], drifting.policy_prior

    def noted(z: Tensor, noise: Tensor | None) -> Tensor:
        asked.append(prior(z, noise))
        return asked[-1]

    drifting.policy_prior = noted
    plan = kind(**SMALL).plan(drifting, z, None, None, seeded(), keep_candidates=True)
    assert_close(plan.candidates[:, :8], torch.stack(asked, 2))
    for b in range(3):
        assert_close(plan.candidate_values[b], h_step_return(drifting, z[b], plan.candidates[b], 0.99))
    assert_close(plan.value, h_step_return(drifting, z, plan.mean.unsqueeze(1), 0.99).squeeze(1))


@BOTH
def test_warm_starts_end_in_the_neutral_action(drifting, kind: type[MPPI] | type[CEM]) -> None:
    # So narrow a search returns where it started.
    planner = kind(**SMALL | {"num_prior": 0, "iterations": 1}, min_std=1e-6, max_std=1e-6)
    before = torch.rand(3, 4, 2, generator=seeded()) - 0.5
    previous = Plan(before[:, 0], before, torch.zeros_like(before), torch.zeros(3))
    fresh = torch.tensor([False, True, False])
    plan = planner.plan(drifting, torch.randn(3, 6), previous, fresh, seeded())
    wanted = torch.cat([before[:, 1:], NEUTRAL.expand(3, 1, 2)], 1)
    wanted[1] = NEUTRAL
    assert_close(plan.mean, wanted, atol=1e-5, rtol=0)


@BOTH
def test_exploring_draws_around_the_plan_within_the_limits(drifting, kind: type[MPPI] | type[CEM]) -> None:
    z = torch.randn(200, 6, generator=seeded(1))
    plan = kind(**SMALL, min_std=2.0).plan(drifting, z, None, None, seeded(), explore=True)
    assert plan.action.abs().amax(0).tolist() == [1, 1]
    assert not torch.equal(plan.action, plan.mean[:, 0])
    narrow = kind(**SMALL, min_std=1e-6, max_std=1e-6).plan(drifting, z, None, None, seeded(), explore=True)
    assert_close(narrow.action, narrow.mean[:, 0], atol=1e-5, rtol=0)
