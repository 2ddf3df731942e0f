"""The squashed Gaussian against the library's own, and where tanh saturates."""

import pytest
import torch
from torch.testing import assert_close

from mpc_sgft.learning.gaussian import gaussian_tanh, gaussian_tanh_log_prob


def test_gaussian_tanh_log_density_against_torch_distributions():
    generator = torch.Generator().manual_seed(0)
    mean, noise = (torch.randn(50, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    log_std = torch.randn(50, 3, generator=generator, dtype=torch.float64) * 0.3 - 0.5
    action, log_prob = gaussian_tanh(mean, log_std, noise)
    normal = torch.distributions.Normal(mean, log_std.exp())
    squashed = torch.distributions.TransformedDistribution(normal, torch.distributions.TanhTransform())
    assert_close(log_prob, squashed.log_prob(action).sum(-1))


def test_log_density_of_an_action_is_that_of_its_sample_and_finite_at_the_edge():
    generator = torch.Generator().manual_seed(0)
    mean, log_std, noise = (0.3 * torch.randn(50, 3, generator=generator, dtype=torch.float64) for _ in range(3))
    action, log_prob = gaussian_tanh(mean, log_std, noise)
    assert action.abs().max() < 0.99
    assert_close(gaussian_tanh_log_prob(mean, log_std, action), log_prob)
    edge = torch.tensor([[1.0, -1.0, 1.0]], dtype=torch.float64)
    assert_close(gaussian_tanh_log_prob(mean, log_std, edge), gaussian_tanh_log_prob(mean, log_std, 0.999 * edge))
    assert gaussian_tanh_log_prob(mean, log_std, edge).isfinite().all()


def test_gaussian_tanh_density_integrates_to_one():
    grid = torch.linspace(-6, 6, 200_001, dtype=torch.float64).unsqueeze(-1)  # noise
    action, log_prob = gaussian_tanh(torch.tensor([0.4], dtype=torch.float64), torch.tensor([-0.3]).double(), grid)
    assert torch.trapezoid(log_prob.exp(), action.squeeze(-1)).item() == pytest.approx(1.0, abs=1e-5)


def test_gaussian_tanh_is_finite_where_tanh_saturates():
    action, log_prob = gaussian_tanh(torch.tensor([40.0]), torch.tensor([0.0]), torch.tensor([0.0]))
    assert action.item() == 1.0 and log_prob.isfinite()
