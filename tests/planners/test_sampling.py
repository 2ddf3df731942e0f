"""MPPI and CEM: they find known optima, and every part of the search does what it says."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from planners.base import Plan, h_step_return, sgft_objective
from planners.cem import CEM
from planners.mppi import MPPI

BOTH = pytest.mark.parametrize("kind", [MPPI, CEM])
SMALL = {"action_dim": 2, "num_candidates": 64, "num_prior": 8, "num_elites": 16, "iterations": 3}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("decay", [1.0, 1.25])
@pytest.mark.parametrize(
    "planner", [MPPI(action_dim=1, discount=0.95, temperature=0.2), CEM(action_dim=1, discount=0.95)]
)
def test_finds_the_riccati_action(double_integrator, planner: MPPI | CEM, decay: float) -> None:
    planner = replace(planner, candidate_decay=decay)
    model = double_integrator(discount=0.95)
    x = torch.rand(8, 2, generator=seeded(1), dtype=torch.float64) * 0.7 - 0.35
    best = -x @ model.gain.T  # [8, 1]
    assert best.abs().max() < 1  # the limits do not bind
    plan = planner.plan(model, x, None, None, seeded())
    assert_close(plan.action, best, atol=0.04, rtol=0)
    assert_close(plan.value, model.terminal_value(x), atol=2e-3, rtol=0)
    assert (plan.value <= model.terminal_value(x) + 1e-9).all()  # nothing beats the optimum


@BOTH
def test_warm_starts_stay_on_the_riccati_path(double_integrator, kind: type[MPPI] | type[CEM]) -> None:
    model, generator, plan = double_integrator(discount=0.95), seeded(2), None
    planner = kind(action_dim=1, discount=0.95)
    x = torch.rand(8, 2, generator=generator, dtype=torch.float64) * 0.7 - 0.35
    for _ in range(5):
        plan = planner.plan(model, x, plan, None, generator)
        assert_close(plan.action, -x @ model.gain.T, atol=0.04, rtol=0)
        x = model.next(x, plan.action)


@BOTH
def test_the_plan_is_the_refit_of_its_own_environment(random_model, kind: type[MPPI] | type[CEM]) -> None:
    """Batched equals one by one: the last pool of each environment alone gives its mean and std."""
    model, z = random_model(), torch.randn(7, 6, generator=seeded(1))
    planner = kind(**SMALL, chunk_rows=100)  # chunks that cut through environments
    plan = planner.plan(model, z, None, None, seeded(), keep_candidates=True)
    for b in range(7):
        values = h_step_return(model, z[b], plan.candidates[b], 0.99)
        assert_close(plan.candidate_values[b], values)
        mean, std = planner.refit(plan.candidates[b : b + 1], plan.candidate_values[b : b + 1])
        assert_close((plan.mean[b], plan.std[b]), (mean[0], std[0]))


@BOTH
def test_batched_plans_are_as_good_as_single_ones(double_integrator, kind: type[MPPI] | type[CEM]) -> None:
    model, planner, generator = double_integrator(discount=0.95), kind(action_dim=1, discount=0.95), seeded(5)
    x = torch.rand(6, 2, generator=generator, dtype=torch.float64) * 0.7 - 0.35
    batched = planner.plan(model, x, None, None, generator)
    single = [planner.plan(model, x[b : b + 1], None, None, generator) for b in range(6)]
    assert_close(batched.mean, torch.cat([plan.mean for plan in single]), atol=0.15, rtol=0)
    assert_close(batched.value, torch.cat([plan.value for plan in single]), atol=2e-3, rtol=0)


@BOTH
def test_a_chunk_changes_no_plan(random_model, kind: type[MPPI] | type[CEM]) -> None:
    model, z = random_model().double(), torch.randn(5, 6, generator=seeded(1), dtype=torch.float64)
    plans = [kind(**SMALL, chunk_rows=rows).plan(model, z, None, None, seeded()) for rows in (1, 50, 10_000)]
    for plan in plans[1:]:
        assert_close(plan.mean, plans[0].mean)


@BOTH
def test_minus_the_value_now_changes_no_plan(random_model, kind: type[MPPI] | type[CEM]) -> None:
    model, planner = random_model().double(), kind(**SMALL)
    z = 2 * torch.randn(5, 6, generator=seeded(1), dtype=torch.float64)
    pool = torch.rand(5, 64, 4, 2, generator=seeded(2), dtype=torch.float64) * 2 - 1
    assert model.terminal_value(z).std() > 0.1  # the constants differ between environments
    plain = planner.refit(pool, h_step_return(model, z, pool, 0.99))
    shaped = planner.refit(pool, sgft_objective(model, z, pool, 0.99))
    assert_close(shaped, plain)


@BOTH
def test_the_size_of_rewards_changes_no_plan(random_model, kind: type[MPPI] | type[CEM]) -> None:
    small, large = random_model().double(), random_model(scale=100.0).double()
    value = large.terminal_value
    large.terminal_value, large.value_range = lambda z: 100 * value(z), 100.0
    z = torch.randn(5, 6, generator=seeded(1), dtype=torch.float64)
    plans = [kind(**SMALL).plan(model, z, None, None, seeded()) for model in (small, large)]
    assert_close(plans[1].mean, plans[0].mean)
    assert_close(plans[1].value, 100 * plans[0].value)
    large.value_range = 1.0
    assert torch.allclose(kind(**SMALL).plan(large, z, None, None, seeded()).mean, plans[0].mean) == (kind is CEM)


def test_cold_picks_the_best_and_hot_averages() -> None:
    pool, values = torch.rand(3, 64, 4, 2, generator=seeded()), torch.randn(3, 64, generator=seeded(1))
    best = pool[torch.arange(3), values.argmax(1)]
    cold, std = MPPI(**SMALL, temperature=1e-6).refit(pool, values)
    assert_close(cold, best)
    assert (std == 0.05).all()
    assert_close(MPPI(**SMALL, temperature=1e6).refit(pool, values)[0], CEM(**SMALL).refit(pool, values)[0])
    assert not torch.allclose(MPPI(**SMALL, temperature=1.0).refit(pool, values)[0], best, atol=0.01)


def test_weights_by_hand() -> None:
    values = torch.tensor([[3.0, 1.0, 1.0]])
    e = torch.tensor(-1.0).exp()  # (1 - 3) / 2
    assert_close(MPPI(action_dim=1, temperature=2.0).weights(values), torch.tensor([[1.0, e, e]]) / (1 + 2 * e))
    assert_close(CEM(action_dim=1).weights(values), torch.full((1, 3), 1 / 3))


def test_refit_by_hand() -> None:
    pool = torch.tensor([0.8, -1.0, 0.2, 0.4]).view(1, 4, 1, 1)
    planner = CEM(action_dim=1, horizon=1, num_candidates=4, num_prior=0, num_elites=2)
    mean, std = planner.refit(pool, torch.tensor([[5.0, -7.0, 6.0, 1.0]]))  # elites 0.8 and 0.2
    assert_close((mean.flatten(), std.flatten()), (torch.tensor([0.5]), torch.tensor([0.3])))


@BOTH
def test_std_is_clamped_on_both_sides(random_model, kind: type[MPPI] | type[CEM]) -> None:
    z = torch.randn(5, 6, generator=seeded(1))
    narrow = kind(**SMALL, min_std=0.01, max_std=0.02).plan(random_model(), z, None, None, seeded())
    wide = kind(**SMALL, min_std=1.5).plan(random_model(), z, None, None, seeded())
    assert narrow.std.max() <= 0.02 and narrow.std.min() >= 0.01
    assert (wide.std == 1.5).all()  # elites within [-1, 1] never spread that far


@BOTH
def test_rewards_of_300_stay_finite(random_model, kind: type[MPPI] | type[CEM]) -> None:
    z = torch.randn(5, 6, generator=seeded(1))
    for scale in (300.0, -300.0, 1e30):
        plan = kind(**SMALL).plan(random_model(scale=scale), z, None, None, seeded())
        assert all(x.isfinite().all() for x in plan[:4])


def still(mean: Tensor) -> Plan:
    return Plan(mean[:, 0], mean, torch.zeros_like(mean), torch.zeros(len(mean)))


@BOTH
def test_the_warm_start_is_shifted_and_reset_where_fresh(random_model, kind: type[MPPI] | type[CEM]) -> None:
    # So narrow a search returns where it started.
    planner = kind(**SMALL | {"num_prior": 0, "iterations": 1}, min_std=1e-6, max_std=1e-6)
    before = torch.rand(3, 4, 2, generator=seeded()) - 0.5
    fresh = torch.tensor([False, True, False])
    plan = planner.plan(random_model(), torch.randn(3, 6), still(before), fresh, seeded())
    wanted = torch.cat([before[:, 1:], torch.zeros(3, 1, 2)], 1)
    wanted[1] = 0
    assert_close(plan.mean, wanted, atol=1e-5, rtol=0)
    plan = planner.plan(random_model(), torch.randn(3, 6), still(before), None, seeded())
    assert_close(plan.mean[:, :-1], before[:, 1:], atol=1e-5, rtol=0)
    assert_close(
        planner.plan(random_model(), torch.randn(3, 6), None, fresh, seeded()).mean, 0 * before, atol=1e-5, rtol=0
    )


@BOTH
def test_a_previous_plan_of_other_sizes_is_refused(random_model, kind: type[MPPI] | type[CEM]) -> None:
    for shape in ((2, 4, 2), (3, 5, 2), (3, 4, 1)):
        with pytest.raises(ValueError, match="The previous plan is"):
            kind(**SMALL).plan(random_model(), torch.zeros(3, 6), still(torch.zeros(shape)), None, seeded())


@BOTH
def test_prior_candidates_stay_in_every_pool_and_are_imagined_once(random_model, kind: type[MPPI] | type[CEM]) -> None:
    model, rows, asked = random_model(), [], []
    right, prior = model.next, model.policy_prior

    def counted(z: Tensor, action: Tensor) -> Tensor:
        rows.append(action[..., 0].numel())
        return right(z, action)

    def noted(z: Tensor, noise: Tensor | None) -> Tensor:
        asked.append(prior(z, noise))
        return asked[-1]

    model.next, model.policy_prior = counted, noted
    plan = kind(**SMALL).plan(model, torch.randn(3, 6), None, None, seeded(), keep_candidates=True)
    assert torch.equal(plan.candidates[:, :8], torch.stack(asked, 2))
    plans = 8 + 3 * (64 - 8) + 1  # of the prior, of three iterations, and the mean
    assert sum(rows) == 3 * 4 * plans  # environments, steps


@BOTH
def test_candidates_and_elites_decay_by_hand(random_model, kind: type[MPPI] | type[CEM]) -> None:
    planner = kind(**SMALL, candidate_decay=2.0)
    assert planner.counts() == [64, 32, 16]
    assert kind(**SMALL, candidate_decay=5.0).counts() == [64, 13, 9]  # 64/25 is fewer than the prior's 8 and one more
    plan = planner.plan(random_model(), torch.randn(3, 6), None, None, seeded(), keep_candidates=True)
    assert plan.candidates.shape[:2] == plan.candidate_values.shape == (3, 16)
    best = plan.candidate_values.topk(4).indices  # 16 elites of 64 are 4 of 16
    elites = plan.candidates.gather(1, best[..., None, None].expand(-1, -1, 4, 2))
    weight = planner.weights(plan.candidate_values.topk(4).values)[..., None, None]
    assert_close(plan.mean, (weight * elites).sum(1))


@BOTH
def test_a_good_prior_is_found_among_candidates(double_integrator, kind: type[MPPI] | type[CEM]) -> None:
    """A prior that knows the answer outweighs a search too short to find it."""
    model = double_integrator(discount=0.95)
    model.policy_prior = lambda z, noise: -z @ model.gain.T + (0 if noise is None else 0.01 * noise)
    x = torch.rand(8, 2, generator=seeded(1), dtype=torch.float64) * 0.7 - 0.35
    few = {"action_dim": 1, "horizon": 8, "discount": 0.95, "num_candidates": 64, "num_elites": 8, "iterations": 1}
    error = [
        (kind(**few, num_prior=n).plan(model, x, None, None, seeded()).action + x @ model.gain.T).abs().mean()
        for n in (0, 8)
    ]
    assert error[1] < 0.02 < error[0]


@BOTH
def test_exploring_draws_around_the_mean_with_the_final_std(double_integrator, kind: type[MPPI] | type[CEM]) -> None:
    model, x = double_integrator(discount=0.99), torch.zeros(2000, 2, dtype=torch.float64)  # at rest: best is about 0
    planner = kind(**SMALL | {"action_dim": 1}, min_std=0.1, max_std=0.1)
    plan = planner.plan(model, x, None, None, seeded())
    assert torch.equal(plan.action, plan.mean[:, 0])
    plan = planner.plan(model, x, None, None, seeded(), explore=True)
    noise = plan.action - plan.mean[:, 0]
    assert_close((noise.mean().item(), noise.std().item()), (0.0, 0.1), atol=0.01, rtol=0)
    plan = kind(**SMALL | {"action_dim": 1}, min_std=2.0).plan(model, x, None, None, seeded(), explore=True)
    assert plan.action.abs().max() == 1  # cut at the limits


@BOTH
@pytest.mark.parametrize(
    "bad",
    [
        {"num_candidates": 0},
        {"num_prior": 512},
        {"num_prior": -1},
        {"num_elites": 513},
        {"iterations": 0},
        {"candidate_decay": 0.9},
        {"min_std": 0.0},
        {"max_std": 0.01},
        {"chunk_rows": 0},
        {"precision": "half"},
    ],
)
def test_numbers_out_of_range_are_refused(kind: type[MPPI] | type[CEM], bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(bad))}={next(iter(bad.values()))!r}"):
        kind(action_dim=2, **bad)


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan")])
def test_a_temperature_must_divide(temperature: float) -> None:
    with pytest.raises(ValueError, match="temperature="):
        MPPI(action_dim=2, temperature=temperature)
