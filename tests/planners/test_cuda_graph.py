"""A plan asks the device for nothing on the way, so that it can be recorded, and replayed it is the same plan."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor, nn

from planners.base import Plan
from planners.cem import CEM
from planners.cuda_graph import WARM_UP
from planners.mppi import MPPI
from tests.host_reads import NoWaiting

SEARCHES = [MPPI, CEM]
NUMBERS = {"action_dim": 2, "num_candidates": 64, "num_prior": 8, "num_elites": 16, "iterations": 3}


@pytest.fixture
def z() -> Tensor:
    return torch.randn(5, 6, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("kind", SEARCHES)
def test_a_search_asks_the_device_for_nothing(random_model, z: Tensor, kind) -> None:
    planner, mean = kind(**NUMBERS), torch.zeros(5, 4, 2)
    with torch.no_grad(), NoWaiting():
        for neutral in (None, torch.tensor([0.5, -0.25])):
            planner._search(random_model(), True, True, torch.Generator().manual_seed(0), z, mean, neutral)
    with torch.no_grad(), NoWaiting(), pytest.raises(AssertionError, match="the host waits"):
        bool(z.sum() > 0)


def plans(planner, model, z: Tensor, count: int) -> tuple[list[Plan], Tensor]:
    """Consecutive plans, each after the other, and where the generator ends."""
    generator, previous, found = torch.Generator("cuda").manual_seed(0), None, []
    for i in range(count):
        fresh = torch.zeros(len(z), dtype=torch.bool, device="cuda")
        previous = planner.plan(model, z + 0.1 * i, previous, fresh, generator, keep_candidates=True, explore=True)
        found.append(previous)
    return found, generator.get_state()


@pytest.mark.gpu
@pytest.mark.parametrize("neutral", [None, [0.5, -0.25]])
@pytest.mark.parametrize("kind", SEARCHES)
def test_replayed_plans_are_those_that_are_not(random_model, z: Tensor, kind, neutral: list[float] | None) -> None:
    model, z = random_model().cuda(), z.cuda()
    if neutral:
        model.neutral_action = lambda: torch.tensor(neutral, device="cuda")
    graphed, ends = plans(kind(**NUMBERS), model, z, WARM_UP + 4)
    launched, same = plans(kind(cuda_graph=False, **NUMBERS), model, z, WARM_UP + 4)
    for mine, theirs in zip(graphed, launched, strict=True):  # the first ones must not have been overwritten
        for a, b in zip(mine, theirs, strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)
    assert torch.equal(ends, same)


@pytest.mark.gpu
def test_a_replay_sees_a_model_that_changed_or_moved(random_model, z: Tensor) -> None:
    planner, model, z = MPPI(**NUMBERS), random_model().cuda(), z.cuda()
    before = plans(planner, model, z, WARM_UP + 2)[0][-1]
    for change in ("in place", "elsewhere"):
        if change == "in place":
            model.v[2].weight.mul_(2)
        else:
            model.v[2].weight = nn.Parameter(-model.v[2].weight, requires_grad=False)
        after = plans(planner, model, z, WARM_UP + 2)[0][-1]
        expected = plans(MPPI(cuda_graph=False, **NUMBERS), model, z, WARM_UP + 2)[0][-1]
        torch.testing.assert_close(after.mean, expected.mean, atol=1e-5, rtol=1e-5)
        assert not torch.equal(after.value, before.value)


@pytest.mark.gpu
def test_a_replay_names_what_is_not_finite(random_model, z: Tensor) -> None:
    planner, model, z = MPPI(**NUMBERS), random_model().cuda(), z.cuda()
    plans(planner, model, z, WARM_UP + 2)
    model.dynamics[0].bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=r"^MPPI: imagined latents are non-finite \(env 0, 1, 2, 3, 4\)"):
        plans(planner, model, z, 1)


ASKS = """
import torch
from planners.cuda_graph import WARM_UP, CudaGraphs
graphs, x, generator = CudaGraphs(), torch.ones(3, device="cuda"), torch.Generator("cuda")
for call in range(WARM_UP + 1):
    assert graphs("asks", lambda generator, x: x * float(x.sum()), (x,), generator).sum() == 9
"""


@pytest.mark.gpu
def test_what_cannot_be_recorded_is_told() -> None:
    """In a process of its own: a failed recording leaves PyTorch's default generator unusable."""
    done = subprocess.run([sys.executable, "-c", ASKS], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "RuntimeError: This cannot be recorded" in done.stderr
    assert "planner.cuda_graph=false" in done.stderr and "AssertionError" not in done.stderr
