"""A driver that pushes the policy prior aside, the same way in every episode."""

import pytest
import torch

from planners.exploring import ExploringPlanner, offset_at

HOW = dict(action_dim=2, steps=5, weight=0.5, offsets=[[0.0, 1.0], [0.4, 1.0], [0.4, -2.0]])


def test_offsets_go_linearly_from_knot_to_knot() -> None:
    knots = torch.tensor(HOW["offsets"])
    share = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0, 1.3])
    torch.testing.assert_close(offset_at(knots, share)[:, 0], torch.tensor([0, 0.2, 0.4, 0.4, 0.4, 0.4]))
    torch.testing.assert_close(offset_at(knots, share)[:, 1], torch.tensor([1, 1, 1, -0.5, -2, -2]))
    assert (offset_at(knots[:1], share) == knots[0]).all(), "a single knot holds"


def test_each_episode_is_driven_from_its_own_first_step_on(random_model) -> None:
    model, planner, plan = random_model(), ExploringPlanner(**HOW), None
    z, begins = torch.randn(2, 6, 6), torch.zeros(2, 6, dtype=torch.bool)
    begins[1, 4] = True
    where = torch.tensor([[0, 1, 2, 3, 4, 4], [0, 1, 2, 3, 0, 1]]) / 4
    for t in range(6):
        plan = planner.plan(model, z[:, t], plan, begins[:, t] if t else None, torch.Generator())
        prior = model.policy_prior(z[:, t], None)
        wanted = (0.5 * prior + offset_at(torch.tensor(HOW["offsets"]), where[:, t])).clamp(-1, 1)
        torch.testing.assert_close(plan.action, wanted)
    ahead = model.next(z[:, 5], plan.action)
    wanted = 0.5 * model.policy_prior(ahead, None) + offset_at(torch.tensor(HOW["offsets"]), torch.tensor([1, 0.5]))
    torch.testing.assert_close(plan.mean[:, 1], wanted.clamp(-1, 1))


@pytest.mark.parametrize("changed", [{"steps": 0}, {"offsets": []}, {"offsets": [[0.1]]}, {"discount": 2.0}])
def test_numbers_that_do_not_fit_are_refused(changed) -> None:
    with pytest.raises(ValueError, match=next(iter(changed))):
        ExploringPlanner(**HOW | changed)
