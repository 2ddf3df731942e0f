"""The quick way to the returns of plans gives the numbers of the plain one, and its precision is what was asked for."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning import precision
from mpc_sgft.learning.world_model import WorldModel
from planners.base import h_step_return
from planners.mppi import MPPI
from tests.host_reads import NoWaiting

CPU = torch.device("cpu")


def model_with(*, memory: int, reward_from: str = "next", command: str = "", residual: bool = False) -> WorldModel:
    torch.manual_seed(3)
    sizes = {"obs_dim": 14, "action_dim": 2, "decode_dim": 5, "latent_dim": 32, "mlp_dim": 48, "enc_dim": 16}
    model = WorldModel(**sizes, num_q=2, memory_dim=memory, reward_from=reward_from, vmin=-3, vmax=3).eval()
    if command:
        model.add_command_map()
    if command == "band":
        model.add_command_band()
        model.dynamics.band_acts.fill_(True)
    if residual:
        model.add_residual(16)
    with torch.no_grad():
        for parameter in model.parameters():  # zero-initialised layers would hide mistakes
            parameter.add_(0.2 * torch.randn_like(parameter))
    return model


@pytest.mark.parametrize("reward_from", ["next", "current"])
@pytest.mark.parametrize("memory", [0, 6])
@pytest.mark.parametrize(("command", "residual"), [("", False), ("map", False), ("map", True), ("band", False)])
@torch.inference_mode()
def test_values_are_the_h_step_return(reward_from: str, memory: int, command: str, residual: bool) -> None:
    model = model_with(memory=memory, reward_from=reward_from, command=command, residual=residual)
    z, plans = model.encode(torch.randn(3, 14)), torch.rand(3, 50, 4, 2) * 2 - 1
    exact = h_step_return(model, z, plans, 0.9)
    assert exact.std(1).min() > 0.1
    for rows in (7, 64, 1000):  # blocks that cut through environments and steps, and none
        assert_close(model.plan_values(z, 0.9, "float32", rows)(plans), exact, rtol=1e-4, atol=1e-4)
    one_step = plans[:, :, :1]
    assert_close(
        model.plan_values(z, 0.9, "float32", 64)(one_step), h_step_return(model, z, one_step, 0.9), rtol=1e-4, atol=1e-4
    )


@torch.inference_mode()
def test_plans_may_end_in_the_critics_at_the_policys_action() -> None:
    model = model_with(memory=6)
    z, plans = model.encode(torch.randn(3, 14)), torch.rand(3, 50, 4, 2) * 2 - 1
    before = h_step_return(model, z, plans, 0.9)
    model.sizes["terminal"] = "q"
    last = z.unsqueeze(1).expand(-1, 50, -1)
    rewards = torch.zeros(3, 50)
    for t, action in enumerate(plans.unbind(2)):
        last, now = model.next(last, action), last
        rewards += 0.9**t * model.reward(now, action, last)
    by_hand = rewards + 0.9**4 * model.q(last, model.policy_prior(last, None), target=True).mean(0)
    assert_close(model.train().plan_values(z, 0.9, "bfloat16", 64)(plans), by_hand, rtol=1e-4, atol=1e-4)
    assert (by_hand - before).abs().mean() > 0.1
    assert WorldModel(**model.sizes).sizes["terminal"] == "q"  # a checkpoint goes on with it


@torch.inference_mode()
def test_bfloat16_orders_plans_as_float32_does() -> None:
    model = model_with(memory=6, command=True)
    z, plans = model.encode(torch.randn(4, 14)), torch.rand(4, 400, 4, 2) * 2 - 1
    exact, rounded = (model.plan_values(z, 0.99, name, 1024)(plans) for name in ("float32", "bfloat16"))
    error = (rounded - exact).std(1) / exact.std(1)
    assert 1e-5 < error.min() and error.max() < 0.05  # rounded, and by little beside what tells plans apart
    assert rounded.dtype == torch.float32


@torch.no_grad()
@pytest.mark.parametrize("terminal", ["value", "q"])
def test_the_host_waits_for_no_search_with_a_world_model(terminal: str) -> None:
    model = model_with(memory=6, command=True, residual=True)
    model.sizes["terminal"] = terminal
    planner = MPPI(action_dim=2, num_candidates=64, num_prior=8, num_elites=32, iterations=3)
    z = model.encode(torch.randn(2, 14))
    with NoWaiting():
        planner._search(model, True, True, torch.Generator().manual_seed(0), z, torch.zeros(2, 4, 2))


def test_a_plan_does_not_depend_on_the_way_to_its_values() -> None:
    model = model_with(memory=6)
    z = model.encode(torch.randn(2, 14)).detach()

    class Plain:
        next, reward, terminal_value, policy_prior = (
            model.next, model.reward, model.terminal_value, model.policy_prior
        )  # fmt: skip
        value_range = 1.0

    planner = MPPI(action_dim=2, num_candidates=64, num_prior=8, num_elites=32, iterations=3, precision="float32")
    quick, plain = (planner.plan(m, z, None, None, torch.Generator().manual_seed(0)) for m in (model, Plain()))
    assert_close(quick.mean, plain.mean, rtol=0, atol=1e-3)


def test_auto_asks_processor_and_width(monkeypatch: pytest.MonkeyPatch) -> None:
    for able, width, expected in (
        (True, 512, torch.bfloat16), (True, 128, torch.float32), (False, 512, torch.float32)
    ):  # fmt: skip
        monkeypatch.setattr(precision, "has_bfloat16", lambda device, able=able: able)
        assert precision.dtype_of_products("auto", width, CPU) is expected
        assert precision.dtype_of_products("float32", width, CPU) is torch.float32
    with pytest.raises(ValueError, match="precision='half'. Available: auto, float32, bfloat16"):
        precision.dtype_of_products("half", 512, CPU)


def test_bfloat16_without_the_hardware_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "has_bfloat16", lambda device: False)
    precision._warn_once.cache_clear()
    with pytest.warns(UserWarning, match="no bfloat16 products"):
        assert precision.dtype_of_products("bfloat16", 128, CPU) is torch.bfloat16
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        precision.dtype_of_products("bfloat16", 128, CPU)
