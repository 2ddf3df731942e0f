"""Pretraining: what an update changes, and that it learns."""

import copy

import pytest
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.testing import assert_close
from torch.utils.flop_counter import FlopCounterMode

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.world_model import PARTS
from planners.cuda_graph import WARM_UP
from tests.host_reads import NoWaiting
from tests.mpc_sgft.learning.agents import (
    changed,
    make_agent,
    make_batch,
    parts,
    pretrained,
)


@pytest.mark.parametrize("num_q", [2, 5])
def test_pretraining_moves_every_part_and_reports_floats(num_q):
    agent = make_agent({"num_q": num_q})
    before = parts(agent)
    for i in range(3):
        metrics = agent.update(make_batch(i))
    assert changed(before, parts(agent)) == set(PARTS)
    assert all(isinstance(v, float) for v in metrics.values())
    assert {"loss", "consistency_loss", "reward_loss", "q_loss", "value_loss", "policy_loss", "entropy"} <= set(metrics)


def test_an_update_in_bfloat16_goes_the_way_of_float32_and_keeps_its_weights_in_it():
    exact, rounded = (make_agent(precision=precision) for precision in ("float32", "bfloat16"))
    batch = make_batch()
    for _ in range(20):
        right, near = exact.update(batch), rounded.update(batch)
    assert near["loss"] != right["loss"] and near["loss"] == pytest.approx(right["loss"], rel=0.02)
    assert {p.dtype for p in rounded.model.parameters()} == {torch.float32}


@pytest.mark.parametrize("imagined_steps", [0, 2])
def test_an_update_computes_no_slope_that_nobody_asks_for(imagined_steps):
    """What rounds its products would: an operation of our own does not know which slopes a backward pass leaves out."""
    counts = []
    for precision in ("float32", "bfloat16"):
        agent = make_agent(precision=precision)
        agent.imagined_steps = imagined_steps
        with FlopCounterMode(display=False) as counted:
            agent.update(make_batch())
        counts.append(counted.get_total_flops())
        assert all(p.requires_grad for p in agent.optimizers.trained)
    assert counts[0] == counts[1]


@pytest.mark.parametrize("terminated", [False, True])
def test_value_and_critics_learn_the_constant_reward_value(terminated):
    """r = 1 for ever is worth 1 / (1 - gamma) = 5; a step that ends the episode is worth 1."""
    agent = make_agent(lr=3e-3, target_rate=0.5, discount=0.8)
    batch = make_batch(batch=16, steps=1, reward=1.0, terminated=terminated)
    if not terminated:  # a world that stays where it is, so that the values of all latents are trained
        batch["next", "observation"] = batch["observation"].clone()
    for _ in range(150 if terminated else 420):
        agent.update(batch)
    with torch.no_grad():
        z = agent.model.encode(batch["observation"][:, 0])
        value, q = agent.model.terminal_value(z), agent.model.q(z, batch["action"][:, 0])
    expected = 1.0 if terminated else 5.0
    assert q.mean().item() == pytest.approx(expected, rel=0.1)
    if not terminated:
        assert value.mean().item() == pytest.approx(expected, rel=0.1)


def test_truncated_steps_bootstrap_like_any_other():
    """`truncated` is not even read: the same batch with it gives the same update."""
    agent, twin = make_agent(), make_agent()
    batch = make_batch()
    other = batch.clone()
    other["next", "truncated"] = torch.ones_like(other["next", "terminated"])
    torch.manual_seed(1)  # dropout
    metrics = agent.update(batch)
    torch.manual_seed(1)
    assert metrics == twin.update(other)


def test_a_policy_update_leaves_no_gradient_in_the_critics():
    agent = make_agent()
    agent.optimizers.model.zero_grad()
    agent._update_policy(agent.model.encode(torch.randn(2, 5, 6)).detach(), read=True)
    assert all(p.grad is None for p in agent.model.q_ensemble.parameters())


def test_the_average_is_of_the_weights_after_each_update():
    agent = make_agent()
    weight, seen = agent.model.policy_head[0].linear.weight, []
    for i in range(3):
        agent.update(make_batch(i))
        seen.append(weight.detach().clone())
    assert_close(agent.averaged.policy_head[0].linear.weight, seen[0] / 4 + seen[1] / 4 + seen[2] / 2)
    assert_close(agent.averaged.normalizer.mean, agent.model.normalizer.mean)
    state = copy.deepcopy(agent.state_dict())
    agent.update(make_batch(7))
    resumed = make_agent()
    resumed.load_state_dict(state)
    resumed.update(make_batch(7))
    for a, b in zip(agent.averaged.state_dict().values(), resumed.averaged.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_value_and_decoder_never_train_the_encoder():
    quiet = dict(consistency_weight=0.0, reward_weight=0.0, q_weight=0.0, value_weight=1.0, decoder_weight=1.0)
    agent = make_agent(**quiet)
    before = parts(agent)
    for i in range(3):  # the heads start at zero and pass no gradient on in the first update
        agent.update(make_batch(i))
    assert changed(before, parts(agent)) & {"encoder", "dynamics"} == set()
    assert {"value_head", "decoder"} <= changed(before, parts(agent))


def test_a_loss_that_is_not_finite_is_named_and_changes_nothing():
    agent = pretrained()
    with torch.no_grad():
        agent.model.reward_head[0].linear.weight[0, 0] = torch.nan
    before = parts(agent)
    with pytest.raises(FloatingPointError, match="^reward_loss is not finite"):
        agent.update(make_batch())
    assert changed(before, parts(agent)) == {"normalizer", "reward_head"}  # nan is never equal to itself


@pytest.mark.parametrize("delay", [1, 2])
def test_the_host_waits_for_no_update_that_is_not_read(monkeypatch, delay):
    agent = make_agent({"dropout": 0.0}, policy_delay=delay)  # on a CPU dropout counts its entries there
    agent.update(make_batch())

    def refuse(*_):
        raise AssertionError("the host waits for the device")

    with monkeypatch.context() as patch, NoWaiting():
        for name in ("tolist", "item", "numpy", "cpu", "__bool__", "__float__", "__int__"):
            patch.setattr(torch.Tensor, name, refuse)
        assert agent.update(make_batch(1), read=False) == {}
        with pytest.raises(AssertionError):
            agent.update(make_batch(2))


@pytest.mark.gpu
@pytest.mark.parametrize("num_q", [2, 5])
def test_the_host_waits_for_no_update_on_a_gpu_either(num_q):
    for cuda_graph in (False, True):
        agent = make_agent(sizes={"num_q": num_q}, device="cuda", cuda_graph=cuda_graph)
        batch = make_batch().to("cuda")
        for _ in range(WARM_UP + 2):
            agent.update(batch, read=False)
        torch.cuda.set_sync_debug_mode("error")
        try:
            agent.update(batch, read=False)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        assert agent.update(batch)["loss"] > 0


def gpu_agents(**changes) -> list[Agent]:
    """The same agent twice, with and without recorded updates."""
    sizes = {"num_q": 5, "dropout": 0.01}
    return [make_agent(sizes=sizes, device="cuda", cuda_graph=on, **changes) for on in (True, False)]


def learn(agent: Agent, start: int, count: int) -> None:
    """Updates of which the last is read, at a rate that falls."""
    torch.cuda.manual_seed(start)  # of dropout
    for i in range(start, start + count):
        agent.scale_learning_rates(0.9**i)
        agent.update(make_batch(i).to("cuda"), read=i == start + count - 1)


def assert_alike(one: Agent, other: Agent) -> None:
    for mine, theirs in ((one.model, other.model), (one.averaged, other.averaged)):
        for (name, a), b in zip(mine.state_dict().items(), theirs.state_dict().values(), strict=True):
            torch.testing.assert_close(a, b, atol=2e-5, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")
    torch.testing.assert_close(one.scale.value, other.scale.value)
    assert one.updates == other.updates and torch.equal(one.generator.get_state(), other.generator.get_state())


@pytest.mark.gpu
@pytest.mark.parametrize("changes", [{}, {"policy_delay": 2}])
def test_recorded_updates_are_those_that_are_launched(changes):
    recorded, launched = gpu_agents(**changes)
    for agent in (recorded, launched):
        agent.hold_value(True)
        learn(agent, 0, 10)
        agent.hold_value(False)
        learn(agent, 10, 10)
    assert_alike(recorded, launched)
    before = recorded.snapshot()
    batch = make_batch().to("cuda")
    batch["next", "reward"][0, 0] = torch.nan
    recorded.update(batch, read=False)
    with pytest.raises(FloatingPointError, match="^reward.* is not finite"):
        recorded.update(make_batch().to("cuda"))
    recorded.restore(before)
    assert recorded.update(make_batch().to("cuda"))["loss"] > 0


@pytest.mark.gpu
def test_recorded_updates_go_on_where_they_were_saved():
    whole, first = (gpu_agents()[0] for _ in range(2))
    learn(whole, 0, 8)
    learn(whole, 8, 8)
    learn(first, 0, 8)
    state = copy.deepcopy(first.state_dict())
    resumed = gpu_agents()[0]
    learn(resumed, 40, 5)  # it has recordings of its own, of something else
    resumed.load_state_dict(state)
    learn(resumed, 8, 8)
    assert_alike(whole, resumed)


def test_an_update_that_is_not_read_is_the_same_update_and_what_was_not_finite_shows_in_the_next():
    read, unread = make_agent(), make_agent()
    for i in range(4):
        torch.manual_seed(i)  # of dropout
        read.update(make_batch(i))
        torch.manual_seed(i)
        unread.update(make_batch(i), read=False)
    assert changed(parts(read), parts(unread)) == set()
    for value in (torch.inf, torch.nan):
        batch = make_batch()
        batch["next", "reward"][0, 0] = value
        unread = make_agent()
        unread.update(batch, read=False)
        with pytest.raises(FloatingPointError, match="^reward.* is not finite"):
            unread.update(make_batch())


def test_the_averaged_weights_are_those_of_torchs_own_average():
    agent = make_agent(average_decay=0.7)
    theirs = AveragedModel(agent.model, multi_avg_fn=get_ema_multi_avg_fn(0.7))
    for i in range(4):
        agent.update(make_batch(i))
        theirs.update_parameters(agent.model)
    found, wanted = agent.averaged.state_dict(), theirs.module.state_dict()
    assert all(torch.equal(found[name], x) for name, x in wanted.items() if "normalizer" not in name)
    assert torch.equal(found["normalizer.mean"], agent.model.normalizer.mean)


def test_with_a_delay_the_policy_and_the_decoder_learn_in_every_second_update():
    agent, moved = make_agent(policy_delay=2), []
    for i in range(4):
        before = parts(agent)
        agent.update(make_batch(i))
        moved.append(changed(before, parts(agent)) & {"policy_head", "decoder", "value_head"})
    assert moved == [{"policy_head", "decoder", "value_head"}, {"value_head"}] * 2
    with pytest.raises(ValueError, match="policy_delay"):
        make_agent(policy_delay=0)


def test_while_the_value_is_held_encoder_and_value_head_stay_and_all_else_learns():
    agent = make_agent()
    agent.hold_value(True)
    before = copy.deepcopy(agent.model.state_dict())
    agent.update(make_batch())
    held = ("encoder.", "value_head.")
    moved = {name.split(".")[0] for name, x in agent.model.state_dict().items() if not torch.equal(x, before[name])}
    assert all(torch.equal(x, before[n]) for n, x in agent.model.state_dict().items() if n.startswith(held))
    assert {"dynamics", "reward_head", "q_ensemble", "policy_head", "decoder"} <= moved
    agent.hold_value(False)
    agent.update(make_batch())
    for part in held:
        assert any(not torch.equal(x, before[n]) for n, x in agent.model.state_dict().items() if n.startswith(part))


@pytest.mark.parametrize("steps", [0, 4])
def test_with_imagined_steps_the_policy_does_not_climb_the_critics(steps):
    plain, other = make_agent(), make_agent()
    for agent in (plain, other):
        agent.imagined_steps = steps
    with torch.no_grad():
        for p in other.model.q_ensemble.parameters():
            p.normal_()
    for agent in (plain, other):
        agent.hold_value(True)  # the critics' gradients reach the dynamics after this update only
        agent.optimizers.model.step = lambda: None
        agent.update(make_batch())
    same = all(
        torch.equal(a, b) for a, b in zip(*(x.model.policy_head.parameters() for x in (plain, other)), strict=True)
    )
    assert same == (steps > 0)


@torch.no_grad()
def test_with_imagined_steps_values_are_still_measured_by_those_of_states():
    agent = make_agent(scale_rate=1.0)
    agent.imagined_steps = 4
    agent.hold_value(True)  # so that what is measured stays as it is
    for p in agent.model.value_head.parameters():
        p.normal_(std=3.0)
    batch = make_batch()
    with torch.enable_grad():
        metrics = agent.update(batch)
    values = agent.model.terminal_value(agent.model.encode(batch["observation"][:, 0]))
    low, high = torch.quantile(values, torch.tensor([0.05, 0.95]))
    assert float(agent.scale.value) == pytest.approx(float(high - low), rel=1e-4) and high - low > 2
    assert metrics["scale"] == pytest.approx(float(agent.objective_scale.value)) != float(agent.scale.value)
