"""The world model's shapes, starting values and residual."""

import copy

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning.layers import BLOCK_ROWS
from mpc_sgft.learning.world_model import PARTS, WorldModel

SIZES = dict(obs_dim=10, action_dim=2, decode_dim=4, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=3)


def tiny(**changes) -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(**(SIZES | changes))


def test_shapes_with_any_leading_dimensions():
    model = tiny()
    z = model.encode(torch.randn(5, 7, 10))
    action = torch.rand(5, 7, 2) * 2 - 1
    next_z = model.next(z, action)
    assert z.shape == next_z.shape == (5, 7, 16)
    assert model.reward(z, action, next_z).shape == model.terminal_value(z).shape == (5, 7)
    assert model.q(z, action).shape == (3, 5, 7)
    assert model.q_logits(z, action, heads=[2, 0]).shape == (2, 5, 7, 101)
    sampled, log_prob = model.policy(z, torch.randn(5, 7, 2))
    assert sampled.shape == (5, 7, 2) and log_prob.shape == (5, 7)
    assert model.policy_prior(z, None).abs().max() <= 1
    assert model.decode(z).shape == (5, 7, 4)


def test_planner_facing_numbers_do_not_depend_on_blocks_or_gradients():
    model = tiny()
    torch.nn.init.normal_(model.value_head[-1].weight)
    torch.nn.init.normal_(model.reward_head[-1].weight)
    z = model.encode(torch.randn(BLOCK_ROWS + 5, 10)).detach()
    action = torch.rand(len(z), 2) * 2 - 1
    trained = [
        model.next(z, action),
        model.reward(z, action, z),
        model.terminal_value(z),
        model.policy_prior(z, action),
    ]
    with torch.inference_mode():
        planned = [model.next(z, action), model.reward(z, action, z), model.terminal_value(z)]
        planned.append(model.policy_prior(z, action))
    for a, b in zip(trained, planned, strict=True):
        assert_close(a, b, rtol=1e-5, atol=1e-5)


def test_zero_at_the_start_and_targets_equal_critics():
    model = tiny()
    z, action = model.encode(torch.randn(4, 10)), torch.zeros(4, 2)
    for value in (model.reward(z, action, z), model.terminal_value(z), model.q(z, action)):
        assert_close(value, torch.zeros_like(value), atol=1e-5, rtol=0)
    assert_close(model.q_logits(z, action), model.q_logits(z, action, target=True))


@pytest.mark.parametrize("source", ["next", "current"])
def test_reward_reads_only_the_latent_it_says(source):
    model = tiny(reward_from=source)
    torch.nn.init.normal_(model.reward_head[-1].weight)
    z, other = model.encode(torch.randn(2, 4, 10))
    action = torch.zeros(4, 2)
    same_when_z_changes = torch.equal(model.reward(z, action, other), model.reward(other, action, other))
    assert same_when_z_changes == (source == "next")


def test_target_rate_is_the_share_of_new_weights():
    model = tiny()
    old = model.target_q[0][0].linear.weight.clone()
    with torch.no_grad():
        model.q_ensemble[0][0].linear.weight.add_(1.0)
    model.update_targets(0.25)
    assert_close(model.target_q[0][0].linear.weight, old + 0.25)


def test_decoder_returns_raw_units_and_never_trains_the_latent():
    model = tiny()
    model.normalizer.update(100 + 5 * torch.randn(500, 10))
    observation = 100 + 5 * torch.randn(6, 10)
    z = model.encode(observation)
    assert not torch.autograd.grad(model.decode(z).sum(), z, allow_unused=True)[0]
    assert (model.decode(z) - 100).abs().max() < 20


def test_the_value_sees_commands_as_the_simulator_would_have_called_them():
    """A machine that does half of what it is told: V of real commands is V of their halves."""
    model = tiny(memory_dim=4)
    z = model.encode(torch.randn(20, 10))
    model.value_head[-1].weight.data.normal_()
    before = model.terminal_value(z)
    model.add_command_map()
    assert torch.equal(model.terminal_value(z), before)
    with torch.no_grad():
        model.dynamics.command.weight.mul_(0.5)
    halved = torch.cat([z[:, :-4], 0.5 * z[:, -4:]], 1)
    after = model.terminal_value(z)
    model.dynamics.command = None
    assert_close(after, model.terminal_value(halved))
    assert not torch.allclose(after, before)


def test_residual_starts_exactly_equal_and_only_it_trains():
    model = tiny()
    z, action = model.encode(torch.randn(64, 10)).detach(), torch.rand(64, 2)
    before = model.next(z, action)
    model.add_residual()
    assert torch.equal(model.next(z, action), before)
    model.next(z, action)[:, 0].sum().backward()
    assert all(p.grad is None for p in model.dynamics.base.parameters())
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in model.dynamics.residual.parameters())
    with pytest.raises(ValueError, match="already"):
        model.add_residual()


def test_what_is_added_lies_where_the_model_does():
    model = tiny(memory_dim=4).to("meta")  # a device like any other here
    model.add_residual(), model.add_command_map(), model.add_command_band(), model.add_observation_map([[0, 1]])
    assert {x.device.type for x in (*model.parameters(), *model.buffers())} == {"meta"}


def test_dropout_only_in_critics_while_training_and_never_in_targets():
    model = tiny(dropout=0.5)
    for head in model.q_ensemble:
        torch.nn.init.normal_(head[-1].weight)
    model.target_q = copy.deepcopy(model.q_ensemble).requires_grad_(False)
    model.train()
    z, action = model.encode(torch.randn(8, 10)), torch.zeros(8, 2)
    assert not torch.equal(model.q_logits(z, action), model.q_logits(z, action))
    assert torch.equal(model.q_logits(z, action, target=True), model.q_logits(z, action, target=True))
    assert torch.equal(model.next(z, action), model.next(z, action))
    model.eval()
    assert torch.equal(model.q_logits(z, action), model.q_logits(z, action))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"latent_dim": 20}, "simnorm_dim=8"),
        ({"decode_dim": 11}, "obs_dim=10"),
        ({"num_q": 1}, "2"),
        ({"reward_from": "x"}, "next"),
        ({"terminal": "x"}, "value, q"),
    ],
)
def test_wrong_sizes_stop_with_the_value(change, message):
    with pytest.raises(ValueError, match=message):
        tiny(**change)


def test_repr_counts_every_part():
    text = repr(tiny())
    assert all(part in text for part in PARTS if part != "normalizer")
