"""What trains, what stays, and that it learns."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.world_model import PARTS, WorldModel
from mpc_sgft.methods.sgft import SGFT
from mpc_sgft.methods.tdmpc2 import TDMPC2
from mpc_sgft.methods.zero_shot import ZeroShot

SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)
NUMBERS = dict(
    discount=0.9,
    rho=0.5,
    lr=3e-4,
    encoder_lr_share=0.3,
    grad_clip=20.0,
    consistency_weight=20.0,
    reward_weight=0.1,
    q_weight=0.1,
    value_weight=0.1,
    decoder_weight=1.0,
    target_rate=0.01,
    scale_rate=0.01,
    entropy_coef=0.01,
    average_decay=0.5,
    entropy_lr=1e-3,
)
SHARED = dict(slice_len=3, action_noise=0.0)
NO_GATE = dict(gate=False, gate_margin=0.9, gate_memory=5)
OURS = dict(anchor=0.0, residual=False, command_map=False, command_lr=2e-2)
SGFT_NUMBERS = dict(
    horizon=4, lr=3e-4, policy_lr=3e-4, entropy_coef=1e-4, rho=0.5, updates=1, **SHARED, **NO_GATE, **OURS
)


def hand_over(agent: Agent, name: str = "sgft", **changes):
    """Give an agent to a method; returns its update of a batch."""
    if name == "sgft":
        method = SGFT(**(SGFT_NUMBERS | changes))
    else:
        method = TDMPC2(updates=1, **SHARED) if name == "tdmpc2" else ZeroShot(**SHARED)
    method.take_over(agent)
    return lambda batch, weight=None: method.update(agent, batch, rollouts=1, weight=weight)


def make_agent(sizes=None, **changes) -> Agent:
    torch.manual_seed(0)
    return Agent(WorldModel(**(SIZES | (sizes or {}))), **(NUMBERS | changes))


def make_batch(seed=0, batch=32, steps=3, reward=None, terminated=False):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(batch, steps + 1, 6, generator=generator)
    rewards = (
        torch.randn(batch, steps, 1, generator=generator) if reward is None else torch.full((batch, steps, 1), reward)
    )
    ended = torch.zeros(batch, steps, 1, dtype=torch.bool)
    ended[:, -1] = terminated
    following = {"observation": observation[:, 1:], "reward": rewards, "terminated": ended}
    action = torch.rand(batch, steps, 2, generator=generator) * 2 - 1
    return TensorDict(
        {"observation": observation[:, :-1], "action": action, "next": TensorDict(following, [batch, steps])},
        [batch, steps],
    )


def pretrained(**changes) -> Agent:
    agent = make_agent(**changes)
    for i in range(5):
        agent.update(make_batch(i))
    return agent


def parts(agent):
    tensors = {p: {k: v.clone() for k, v in getattr(agent.model, p).state_dict().items()} for p in PARTS}
    return tensors


def changed(before, after):
    return {p for p in PARTS if any(not torch.equal(before[p][k], after[p][k]) for k in before[p])}


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


@pytest.mark.parametrize("residual", [False, True])
def test_sgft_changes_dynamics_and_policy_and_no_frozen_bit(residual):
    agent = pretrained()
    update = hand_over(agent, residual=residual)
    before, frozen = parts(agent), agent.frozen_hash()
    for i in range(3):
        metrics = update(make_batch(10 + i))
    assert changed(before, parts(agent)) == {"dynamics", "policy_head"}
    assert agent.frozen_hash() == frozen
    assert {"consistency_loss", "policy_loss", "objective"} <= set(metrics)
    if residual:
        base = {k: v for k, v in before["dynamics"].items() if k.startswith("base.")}
        now = parts(agent)["dynamics"]
        assert base and all(torch.equal(v, now[k]) for k, v in base.items())


def test_frozen_hash_notices_a_single_changed_entry():
    agent = pretrained()
    hand_over(agent)
    frozen = agent.frozen_hash()
    with torch.no_grad():
        agent.model.normalizer.mean[0] += 1e-6
    assert agent.frozen_hash() != frozen


def test_tdmpc2_trains_everything_but_the_normaliser():
    agent = pretrained()
    update = hand_over(agent, "tdmpc2")
    before, frozen = parts(agent), agent.frozen_hash()
    for i in range(3):
        update(make_batch(10 + i))
    assert changed(before, parts(agent)) == set(PARTS) - {"normalizer"}
    assert agent.frozen_hash() == frozen


def test_zero_shot_trains_nothing_and_says_so():
    agent = pretrained()
    update, before = hand_over(agent, "zero_shot"), parts(agent)
    with pytest.raises(ValueError, match="zero_shot"):
        update(make_batch())
    assert changed(before, parts(agent)) == set() and agent.trainable == ()


def test_transfer_lowers_the_model_error_on_what_it_saw():
    agent = pretrained()
    update = hand_over(agent, lr=3e-3)
    batch = make_batch(77, batch=16)
    before = agent.model_error(batch)
    for _ in range(150):
        update(batch)
    assert before.shape == (16, 3)
    assert agent.model_error(batch).mean() < 0.7 * before.mean()


def test_slice_weights_choose_what_the_dynamics_learn():
    agent = pretrained()
    update = hand_over(agent, lr=3e-3)
    batch, weight = make_batch(77, batch=16), torch.tensor([2.0, 0.0]).repeat(8)
    before = agent.model_error(batch)
    for _ in range(150):
        update(batch, weight)
    ratio = agent.model_error(batch).mean(1) / before.mean(1)
    assert ratio[::2].mean() < ratio[1::2].mean() - 0.1


def test_anchor_keeps_the_dynamics_near_the_pretrained_ones():
    def distance(anchor):
        agent = pretrained()
        update = hand_over(agent, lr=3e-3, anchor=anchor)
        before = parts(agent)["dynamics"]
        for i in range(30):
            update(make_batch(i))
        return sum((v - before[k]).square().sum() for k, v in parts(agent)["dynamics"].items())

    assert distance(1.0) < 0.2 * distance(0.0)


def test_snapshot_and_restore_undo_updates_and_go_on_alike():
    agent = pretrained()
    update = hand_over(agent)
    update(make_batch(1))
    snapshot, noise = agent.snapshot(), agent.generator.get_state()
    first = [update(make_batch(i)) for i in (2, 3)]
    after = parts(agent)
    agent.restore(snapshot)
    assert changed(after, parts(agent)) == {"dynamics", "policy_head"}
    agent.generator.set_state(noise)
    assert [update(make_batch(i)) for i in (2, 3)] == first


@pytest.mark.parametrize("method", [None, "sgft", "tdmpc2", "residual"])
def test_resume_gives_the_same_numbers(method):
    def begin(agent):
        if method is None:
            return agent.update
        return hand_over(agent, "sgft", horizon=2, residual=True) if method == "residual" else hand_over(agent, method)

    agent = pretrained()
    update = begin(agent)
    update(make_batch(20))
    state = agent.state_dict()
    expected = [update(make_batch(i)) for i in (21, 22)]
    twin = make_agent()
    again = begin(twin)
    twin.load_state_dict(state)
    assert [again(make_batch(i)) for i in (21, 22)] == expected
    assert changed(parts(agent), parts(twin)) == set()


def test_a_policy_update_leaves_no_gradient_in_the_critics():
    agent = make_agent()
    agent.model_optimizer.zero_grad()
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


@pytest.mark.parametrize("transfer", [False, True])
@pytest.mark.parametrize("name", ["observation", "action", "reward"])
def test_a_batch_that_is_not_finite_is_named_and_changes_nothing(transfer, name):
    agent, batch = pretrained(), make_batch()
    update = hand_over(agent) if transfer else agent.update
    place = batch["action"] if name == "action" else batch["next", name]
    place[1, -1, 0] = torch.nan
    before = parts(agent)
    with pytest.raises(FloatingPointError, match=f"^{name} is not finite"):
        update(batch)
    assert changed(before, parts(agent)) == set()


def test_a_loss_that_is_not_finite_is_named_and_changes_nothing():
    agent = pretrained()
    with torch.no_grad():
        agent.model.reward_head[0].linear.weight[0, 0] = torch.nan
    before = parts(agent)
    with pytest.raises(FloatingPointError, match="^reward_loss is not finite"):
        agent.update(make_batch())
    assert changed(before, parts(agent)) == {"normalizer", "reward_head"}  # nan is never equal to itself


class _NoWaiting(TorchDispatchMode):
    """Refuses what brings a number from the device to the host."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert func is not torch.ops.aten._local_scalar_dense.default, "the host waits for the device"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("delay", [1, 2])
def test_the_host_waits_for_no_update_that_is_not_read(monkeypatch, delay):
    agent = make_agent({"dropout": 0.0}, policy_delay=delay)  # on a CPU dropout counts its entries there
    agent.update(make_batch())

    def refuse(*_):
        raise AssertionError("the host waits for the device")

    with monkeypatch.context() as patch, _NoWaiting():
        for name in ("tolist", "item", "numpy", "cpu", "__bool__", "__float__", "__int__"):
            patch.setattr(torch.Tensor, name, refuse)
        assert agent.update(make_batch(1), read=False) == {}
        with pytest.raises(AssertionError):
            agent.update(make_batch(2))


@pytest.mark.gpu
def test_the_host_waits_for_no_update_on_a_gpu_either():
    agent = make_agent(device="cuda")
    batch = make_batch().to("cuda")
    agent.update(batch)
    torch.cuda.set_sync_debug_mode("error")
    try:
        agent.update(batch, read=False)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert agent.update(batch)["loss"] > 0


def test_an_update_that_is_not_read_is_the_same_update_and_what_was_not_finite_shows_in_the_next():
    read, unread = make_agent(), make_agent()
    for i in range(4):
        torch.manual_seed(i)  # of dropout
        read.update(make_batch(i))
        torch.manual_seed(i)
        unread.update(make_batch(i), read=False)
    assert changed(parts(read), parts(unread)) == set()
    batch = make_batch()
    batch["next", "reward"][0, 0] = torch.inf
    unread.update(batch, read=False)
    with pytest.raises(FloatingPointError, match="^reward is not finite"):
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
        agent.model_optimizer.step = lambda: None
        agent.update(make_batch())
    same = all(
        torch.equal(a, b) for a, b in zip(*(x.model.policy_head.parameters() for x in (plain, other)), strict=True)
    )
    assert same == (steps > 0)
