"""Tiny hand-made models that satisfy `planners.base.Model`, as fixtures that return the class."""

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from torch import Tensor, nn


class DoubleIntegrator:
    """x' = A x + B u, cost x'Qx + u'Ru, tail -x'Px of the discounted Riccati equation: best action -K x. float64."""

    value_range = 1.0

    def __init__(self, discount: float, dt: float = 0.5) -> None:
        a, b = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[0.5 * dt * dt], [dt]])
        q, r = np.diag([1.0, 0.1]), np.array([[0.3]])
        root = discount**0.5
        p = solve_discrete_are(root * a, root * b, q, r)
        gain = discount * np.linalg.solve(r + discount * b.T @ p @ b, b.T @ p @ a)
        self.a, self.b, self.q, self.r, self.p, self.gain = map(torch.from_numpy, (a, b, q, r, p, gain))

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        return z @ self.a.T + action @ self.b.T

    def reward(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        return -((z @ self.q) * z).sum(-1) - ((action @ self.r) * action).sum(-1)

    def terminal_value(self, z: Tensor) -> Tensor:
        return -((z @ self.p) * z).sum(-1)

    def policy_prior(self, z: Tensor, noise: Tensor | None) -> Tensor:
        mean = torch.zeros_like(z[..., :1])
        return mean if noise is None else torch.tanh(mean + noise)


class Random(nn.Module):
    """Perceptrons with random weights; V is shifted by `offset`, rewards are multiplied by `scale`."""

    def __init__(
        self, seed: int = 0, latent: int = 6, action: int = 2, offset: float = 0.0, scale: float = 1.0
    ) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)

        def net(inputs: int, outputs: int) -> nn.Module:
            layers = nn.Sequential(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, outputs), nn.Tanh())
            for p in layers.parameters():
                nn.init.normal_(p, generator=generator)
            return layers.requires_grad_(False)

        self.dynamics, self.r = net(latent + action, latent), net(2 * latent + action, 1)
        self.v, self.pi = net(latent, 1), net(latent, action)
        self.offset, self.scale, self.value_range = offset, scale, 1.0

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        return self.dynamics(torch.cat([z, action], -1))

    def reward(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        return self.scale * self.r(torch.cat([z, action, next_z], -1)).squeeze(-1)

    def terminal_value(self, z: Tensor) -> Tensor:
        return self.v(z).squeeze(-1) + self.offset

    def policy_prior(self, z: Tensor, noise: Tensor | None) -> Tensor:
        return self.pi(z) if noise is None else (self.pi(z) + 0.3 * noise).clamp(-1, 1)


@pytest.fixture
def double_integrator() -> type[DoubleIntegrator]:
    return DoubleIntegrator


@pytest.fixture
def random_model() -> type[Random]:
    return Random
