"""What every planner of configs/planner/ promises."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor
from torch.testing import assert_close

from planners.base import Plan, h_step_return
from planners.cem import CEM
from planners.mppi import MPPI
from planners.policy import PolicyPlanner

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "planner"
FULL = sorted(p.stem for p in CONFIGS.glob("*.yaml") if "_target_" in OmegaConf.load(p))  # the others vary one of these
PLANNERS = {  # small enough for milliseconds
    "mppi": MPPI(action_dim=2, num_candidates=64, num_prior=8, num_elites=16, iterations=3),
    "cem": CEM(action_dim=2, num_candidates=64, num_prior=8, num_elites=16, iterations=3),
    "policy": PolicyPlanner(action_dim=2),
}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def z() -> Tensor:
    return torch.randn(5, 6, generator=seeded(1))


@pytest.mark.parametrize("name", FULL)
def test_the_config_says_every_number_of_the_planner(name: str) -> None:
    config = OmegaConf.load(CONFIGS / f"{name}.yaml")
    planner = instantiate(config, action_dim=2, discount=0.9)  # the world's number and the task's
    assert type(planner) is type(PLANNERS[name])
    numbers = {field.name: getattr(planner, field.name) for field in fields(planner) if field.init}
    assert {**numbers, "_target_": config._target_} == {**config, "action_dim": 2, "discount": 0.9}


@pytest.mark.parametrize("name", FULL)
def test_every_number_of_a_config_has_its_sentence(name: str) -> None:
    lines = (CONFIGS / f"{name}.yaml").read_text().splitlines()
    assert not [line for line in lines if not line.startswith(("#", "_target_")) and "  # " not in line]


@pytest.mark.parametrize("name", FULL)
@pytest.mark.parametrize("explore", [False, True])
def test_a_plan_is_finite_within_limits_and_of_its_shape(random_model, z: Tensor, name: str, explore: bool) -> None:
    model, planner = random_model(), PLANNERS[name]
    plan = planner.plan(model, z, None, None, seeded(), keep_candidates=True, explore=explore)
    assert plan.action.shape == (5, 2) and plan.mean.shape == plan.std.shape == (5, 4, 2)
    assert plan.candidates is not None and plan.candidate_values is not None
    assert plan.candidate_values.shape == plan.candidates.shape[:2]
    assert plan.memory is None, "the model has no policy that remembers"
    assert all(x.isfinite().all() for x in plan if x is not None)
    assert plan.action.abs().max() <= 1 and plan.mean.abs().max() <= 1 and plan.candidates.abs().max() <= 1
    assert_close(plan.value, h_step_return(model, z, plan.mean.unsqueeze(1), 0.99).squeeze(1))
    assert_close(plan.candidate_values, h_step_return(model, z, plan.candidates, 0.99))
    assert planner.plan(model, z, None, None, seeded()).candidates is None


@pytest.mark.parametrize("name", FULL)
def test_the_same_seed_gives_the_same_plan_bitwise(random_model, z: Tensor, name: str) -> None:
    planner, model = PLANNERS[name], random_model()

    def two_steps(seed: int) -> Plan:
        generator = seeded(seed)
        first = planner.plan(model, z, None, None, generator, explore=True)
        return planner.plan(model, z, first, torch.zeros(5, dtype=torch.bool), generator, True, True)

    torch.manual_seed(1)
    once = two_steps(3)
    torch.manual_seed(2)  # all randomness comes from the generator
    again = two_steps(3)
    assert all(a is b or torch.equal(a, b) for a, b in zip(once, again, strict=True))
    assert not torch.equal(once.action, two_steps(4).action)


@pytest.mark.parametrize("name", FULL)
def test_a_constant_added_to_the_value_changes_no_plan(random_model, z: Tensor, name: str) -> None:
    plain, shifted = (
        PLANNERS[name].plan(random_model(offset=offset).double(), z.double(), None, None, seeded())
        for offset in (0.0, 5.0)
    )
    assert_close(shifted.mean, plain.mean)
    assert_close(shifted.std, plain.std)
    assert_close(shifted.value, plain.value + 0.99**4 * 5.0)


@pytest.mark.parametrize("name", FULL)
@pytest.mark.parametrize(
    ("part", "named"),
    [
        ("policy_prior", "policy-prior actions"),
        ("next", "imagined latents"),
        ("reward", "(candidate values|values of the plan)"),
        ("terminal_value", "(candidate values|values of the plan)"),
    ],
)
@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_named(random_model, z: Tensor, name: str, part: str, named: str, wrong: float) -> None:
    model = random_model()
    right = getattr(model, part)
    setattr(model, part, lambda *args: right(*args) + wrong)
    who = type(PLANNERS[name]).__name__
    with pytest.raises(FloatingPointError, match=rf"^{who}: {named} are non-finite \(env 0, 1, 2, 3, 4\)\.$"):
        PLANNERS[name].plan(model, z, None, None, seeded())


@pytest.mark.parametrize("name", FULL)
def test_the_environment_at_fault_is_named(random_model, z: Tensor, name: str) -> None:
    model, who = random_model(), type(PLANNERS[name]).__name__
    right = model.reward
    model.reward = lambda now, action, after: (
        right(now, action, after) + torch.where(now[..., 0] > 8, -float("inf"), 0.0)
    )
    z[3, 0] = 9.0
    with pytest.raises(FloatingPointError, match=r"values.* are non-finite \(env 3\)\.$"):
        PLANNERS[name].plan(model, z, None, None, seeded())
    z[2, 4] = float("nan")
    with pytest.raises(FloatingPointError, match=rf"^{who}: latents are non-finite \(env 2\)\.$"):
        PLANNERS[name].plan(model, z, None, None, seeded())


@pytest.mark.parametrize("name", FULL)
@pytest.mark.parametrize("bad", [{"action_dim": 0}, {"horizon": 0}, {"discount": 1.5}])
def test_numbers_out_of_range_are_refused_with_their_name(name: str, bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(bad))}={next(iter(bad.values()))}"):
        type(PLANNERS[name])(**{"action_dim": 2, **bad})


@pytest.mark.gpu
@pytest.mark.parametrize("name", FULL)
def test_plans_on_a_gpu(random_model, z: Tensor, name: str) -> None:
    generator = torch.Generator("cuda").manual_seed(0)
    plan = PLANNERS[name].plan(random_model().cuda(), z.cuda(), None, None, generator, explore=True)
    assert plan.action.is_cuda and plan.action.isfinite().all()
