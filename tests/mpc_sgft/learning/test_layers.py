"""Building blocks against the library's own versions, and the laws of the two-hot encoding."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from mpc_sgft.learning import products
from mpc_sgft.learning.layers import (
    BLOCK_ROWS,
    Ensemble,
    Normalizer,
    SimNorm,
    TwoHot,
    by_blocks,
    dropout,
    mish,
    mlp,
    simnorm,
    symexp,
    symlog,
)
from mpc_sgft.learning.products import Linear, linear, products_in


def test_symlog_and_symexp_are_inverse_odd_and_known():
    x = torch.tensor([-1000.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, math.e - 1, 2e4])
    assert_close(symexp(symlog(x)), x, rtol=1e-5, atol=1e-7)
    assert_close(symlog(-x), -symlog(x))
    assert symlog(torch.tensor(math.e - 1)).item() == pytest.approx(1.0)


def test_two_hot_round_trip_is_exact_inside_the_range_and_clips_outside():
    two_hot = TwoHot(101, -10, 10)
    x = torch.tensor([-2e4, -37.5, -1.0, -0.01, 0.0, 0.3, 9.99, 2e4])
    target = two_hot.encode(x)
    assert_close(target.sum(-1), torch.ones(len(x)))
    assert ((target > 0).sum(-1) <= 2).all()
    assert_close(two_hot.decode(target.clamp_min(1e-30).log()), x, rtol=2e-4, atol=1e-5)
    assert two_hot.encode(torch.tensor([1e9, -1e9])).argmax(-1).tolist() == [100, 0]


def test_two_hot_by_hand():
    target = TwoHot(3, -1, 1).encode(torch.tensor([math.e**0.25 - 1, 0.0]))  # symlog 0.25 between bins 0 and 1
    assert_close(target, torch.tensor([[0.0, 0.75, 0.25], [0.0, 1.0, 0.0]]))


def test_two_hot_decode_gradient_numerically():
    two_hot = TwoHot(11, -2, 2).double()
    logits = torch.randn(3, 4, 11, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(two_hot.decode, logits)
    assert_close(two_hot.decode(logits), two_hot.decode(logits.detach()))


def test_simnorm_groups_are_distributions_and_equal_softmax():
    x = 5 * torch.randn(7, 32)
    z = SimNorm(8)(x)
    assert_close(z.view(7, 4, 8).sum(-1), torch.ones(7, 4))
    assert_close(z, x.view(7, 4, 8).softmax(-1).flatten(1), rtol=1e-5, atol=1e-6)
    assert SimNorm(8)(torch.full((1, 32), 1e6)).isfinite().all()


def test_simnorm_slope_is_that_of_the_softmax():
    x = torch.randn(3, 5, 16, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: simnorm(x, 4), x)
    assert_close(simnorm(x, 4), x.unflatten(-1, (4, 4)).softmax(-1).flatten(-2))


def test_rounded_products_and_their_slopes_are_near_the_exact_ones():
    layer, x = Linear(64, 32), torch.randn(3, 50, 64, requires_grad=True)
    exact = layer(x)
    slopes = torch.autograd.grad(exact.square().sum(), (x, layer.weight, layer.bias))
    with products_in(torch.bfloat16):
        rounded = layer(x)
    assert rounded.dtype == torch.float32 and not torch.equal(rounded, exact)
    assert_close(rounded, exact, rtol=0, atol=0.02 * exact.std().item())
    for near, slope in zip(
        torch.autograd.grad(rounded.square().sum(), (x, layer.weight, layer.bias)), slopes, strict=True
    ):
        assert near.dtype == torch.float32 and near.shape == slope.shape
        assert (near - slope).norm() < 0.02 * slope.norm()
    assert torch.equal(layer(x), exact)  # only within


@pytest.mark.parametrize("with_bias", [True, False])
def test_products_without_the_hardware_are_those_of_the_library(with_bias: bool, monkeypatch: pytest.MonkeyPatch):
    """It rounds the same numbers, and sums in float32 too: results differ in the last of 8 bits at most."""
    x, weight, bias = (torch.randn(shape).bfloat16() for shape in ((200, 96), (48, 96), (48,)))
    asked = (x, weight, bias if with_bias else None)
    library = F.linear(*asked)
    monkeypatch.setattr(products, "has_bfloat16", lambda device: False)
    own = linear(*asked)
    assert own.dtype == torch.bfloat16
    assert_close(own, library, rtol=2**-7, atol=1e-5)
    assert (own == library).float().mean() > 0.99
    assert not torch.equal(own.float(), F.linear(*(t if t is None else t.float() for t in asked)))  # it is rounded


@pytest.mark.parametrize("grad", [False, True])
def test_mish_equals_the_library(grad):
    x = torch.cat([torch.linspace(-100, 100, 4001), torch.linspace(-3, 3, 1001)]).requires_grad_(grad)
    exact = x.detach().double().requires_grad_()
    assert_close(mish(x).double(), F.mish(exact), rtol=1e-6, atol=2e-6)
    if grad:
        slope = torch.autograd.grad(mish(x).sum(), x)[0]
        assert_close(slope.double(), torch.autograd.grad(F.mish(exact).sum(), exact)[0], rtol=1e-5, atol=3e-6)


def test_mish_gradient_numerically():
    x = torch.randn(20, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(mish, x)


def test_dropout_drops_the_stated_share_and_keeps_the_mean():
    torch.manual_seed(0)
    x = dropout(torch.ones(1000, 1000), 0.01)
    dropped = (x == 0).float()
    assert dropped.mean().item() == pytest.approx(0.01, abs=5 * math.sqrt(0.01 / 1e6))
    assert x.mean().item() == pytest.approx(1.0, abs=1e-3)
    both = (dropped[:, 0::2] * dropped[:, 1::2]).mean().item()  # neighbours are independent
    assert both == pytest.approx(1e-4, abs=5e-5)


def test_normalizer_matches_all_data_seen_at_once_and_inverts():
    x = torch.randn(1000, 4) * torch.tensor([1.0, 0.01, 30.0, 0.0]) + torch.tensor([0.0, 2.0, -100.0, 5.0])
    x = x.sort(0).values  # the batches differ in their means
    normalizer = Normalizer(4)
    for part in x.split([10, 490, 500]):
        normalizer.update(part)
    assert_close(normalizer.mean, x.mean(0), rtol=1e-4, atol=1e-5)
    assert_close(normalizer.var, x.var(0, correction=0), rtol=1e-3, atol=1e-6)
    inside = x[:, :3]
    assert_close(normalizer.inverse(normalizer(x)[:, :3]), inside, rtol=1e-4, atol=1e-3)
    assert normalizer(torch.full((1, 4), 1e6)).abs().max() == normalizer.limit


def test_by_blocks_changes_no_number_and_keeps_leading_dimensions():
    net = mlp([6, 16, 5])
    x, y = torch.randn(3, BLOCK_ROWS, 4), torch.randn(3, BLOCK_ROWS, 2)

    def together(a, b):
        return net(torch.cat([a, b], -1))

    with torch.no_grad():
        assert_close(by_blocks(together, x, y), together(x, y))
        assert by_blocks(lambda a: net(torch.cat([a, a[..., :2]], -1)).sum(-1), x).shape == (3, BLOCK_ROWS)


def test_mlp_drops_out_on_the_first_layer_only_and_starts_at_zero_if_asked():
    net = mlp([4, 8, 8, 3], dropout=0.5, zero_out=True)
    assert [layer.dropout for layer in net[:-1]] == [0.5, 0.0]
    assert (net(torch.randn(5, 4)) == 0).all()
    with pytest.raises(ValueError, match="zero_out"):
        mlp([4, 3], out=SimNorm(3), zero_out=True)


def test_ensemble_members_and_chosen_heads():
    ensemble = Ensemble(mlp([4, 3]) for _ in range(5))
    x = torch.randn(6, 4)
    assert ensemble(x).shape == (5, 6, 3)
    assert_close(ensemble(x, [3, 1]), ensemble(x)[[3, 1]])
