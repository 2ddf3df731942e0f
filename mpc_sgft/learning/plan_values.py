"""What plans are worth, for a planner that asks thousands of times a second: the same numbers as `h_step_return`.

The world model computes one method after the other, in float32. Here the returns of many plans from the same latents
are worked out together:

- what is the same for all plans, the first product on the latent they start from, is computed once a plan;
- the first layers of two heads that see the same latent are one product;
- the products may run in bfloat16. Inputs and outputs of a product are rounded then;
  LayerNorm, activations, SimNorm, two-hot decoding, commands and sums stay float32.
"""

import torch
from torch import Tensor, nn

from mpc_sgft.learning.dynamics import Dynamics
from mpc_sgft.learning.layers import NormedLinear, TwoHot, normed_mish, simnorm
from mpc_sgft.learning.products import linear


class Head:
    """A perceptron as three steps: its first product on the code, the same on the rest of the input, and what follows.

    Args:
        net: As `layers.mlp` makes it.
        code_dim: Leading inputs that are the code.
        dtype: Of the products.
    """

    def __init__(self, net: nn.Sequential, code_dim: int, dtype: torch.dtype) -> None:
        first, *later = map(_linear_of, net)
        self.on_code = first.weight[:, :code_dim].to(dtype), first.bias.to(dtype)  # [M, D], [M]
        self.on_rest = first.weight[:, code_dim:].T.contiguous()  # [inputs - D, M], float32
        self.later = [(layer.weight.to(dtype), layer.bias.to(dtype)) for layer in later]
        norms = [layer.norm for layer in net if isinstance(layer, NormedLinear)]
        self.hidden_norms, self.out_norm = norms[: len(later)], norms[len(later) :]  # the last layer may have none
        self.dtype = dtype

    def finish(self, first: Tensor) -> Tensor:
        """The output, [n, out], from the first product, [n, M]."""
        x = first
        for norm, (weight, bias) in zip(self.hidden_norms, self.later, strict=True):
            x = linear(normed_mish(x, norm).to(self.dtype), weight, bias).float()
        return self.out_norm[0](x) if self.out_norm else x


def _linear_of(layer: nn.Module) -> nn.Linear:
    own = layer.linear if isinstance(layer, NormedLinear) else layer
    assert isinstance(own, nn.Linear), layer
    return own


class PlanWeights:
    """The weights that imagining plans takes, in the precision of their products.

    Args:
        dynamics, reward_head, value_head, two_hot, reward_from: Of a world model; later changes are not seen.
        dtype: float32 or bfloat16.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        reward_head: nn.Sequential,
        value_head: nn.Sequential,
        two_hot: TwoHot,
        *,
        reward_from: str,
        dtype: torch.dtype,
    ) -> None:
        self.dynamics, self.two_hot, self.reward_from, self.dtype = dynamics, two_hot, reward_from, dtype
        nets = {"dynamics": dynamics.base, "reward": reward_head, "value": value_head}
        self.heads = {name: Head(net, dynamics.code_dim, dtype) for name, net in nets.items()}
        early = reward_from == "current"  # the reward is read from the latent of the step, not from the next one
        self.at_start: tuple[str, ...] = ("dynamics", "reward") if early else ("dynamics",)
        self.on_the_way: tuple[str, ...] = ("dynamics", "reward")
        self.at_end: tuple[str, ...] = ("value",) if early else ("value", "reward")
        self._first: dict[tuple[str, ...], tuple[Tensor, Tensor]] = {
            names: self._joined(names) for names in (self.at_start, self.on_the_way, self.at_end)
        }

    def _joined(self, names: tuple[str, ...]) -> tuple[Tensor, Tensor]:
        weights, biases = zip(*(self.heads[name].on_code for name in names), strict=True)
        return torch.cat(weights), torch.cat(biases)

    def first_products(self, names: tuple[str, ...], code: Tensor) -> dict[str, Tensor]:
        """First products of some heads on a code [n, D], {head: [n, M]}, float32."""
        both = linear(code.to(self.dtype), *self._first[names])
        return {name: part.float() for name, part in zip(names, both.chunk(len(names), -1), strict=True)}


class PlanValues:
    """`h_step_return` of plans that start at the latents z [B, D]; call it with plans [B, N, H, A]: [B, N].

    Args:
        weights: Of the model.
        z: Latent of every environment.
        discount: Per control step.
        rows: Plans imagined at a time on a CPU, so that intermediate results stay in its cache.
    """

    def __init__(self, weights: PlanWeights, z: Tensor, discount: float, rows: int) -> None:
        self.weights, self.discount, self.rows = weights, discount, rows
        self.code, self.memory = z.split([weights.dynamics.code_dim, weights.dynamics.memory_dim], -1)
        self.start = weights.first_products(weights.at_start, self.code)  # {head: [B, M]}

    def __call__(self, plans: Tensor) -> Tensor:
        whose = torch.arange(len(plans), device=plans.device).repeat_interleave(plans.shape[1])
        rows = len(whose) if plans.is_cuda else self.rows
        chunks = zip(whose.split(rows), plans.flatten(0, 1).split(rows), strict=True)
        return torch.cat([self._returns(*chunk) for chunk in chunks]).view(plans.shape[:2])

    def _returns(self, whose: Tensor, plans: Tensor) -> Tensor:
        """Returns of plans [n, H, A] of the environments `whose` [n]: [n]."""
        w, actions = self.weights, plans.unbind(1)
        first = {name: product[whose] for name, product in self.start.items()}
        code, memory = self.code[whose], self.memory[whose]
        rewards: list[Tensor] = []  # the first products of the reward head, one a step
        for t, action in enumerate(actions):
            commands = torch.cat([action, memory], -1)
            if w.reward_from == "current":
                rewards.append(self._first("reward", first, torch.cat([memory, action], -1)))
            code, memory = self._next_code(first, code, commands), commands[:, : memory.shape[1]]
            first = w.first_products(w.on_the_way if t + 1 < len(actions) else w.at_end, code)
            if w.reward_from == "next":
                rewards.append(self._first("reward", first, torch.cat([memory, action], -1)))
        discounts = self.discount ** torch.arange(len(actions) + 1, device=plans.device, dtype=plans.dtype)
        at_end = self._first("value", first, w.dynamics.realised(memory)) if memory.shape[1] else first["value"]
        return discounts[:-1] @ self._rewards(rewards) + discounts[-1] * self._scalars("value", at_end)

    def _next_code(self, first: dict[str, Tensor], code: Tensor, commands: Tensor) -> Tensor:
        dynamics, realised = self.weights.dynamics, self.weights.dynamics.realised(commands)
        logits = self.weights.heads["dynamics"].finish(self._first("dynamics", first, realised))
        if dynamics.residual is not None:
            logits = logits + dynamics.residual(torch.cat([code, realised], -1))
        return simnorm(logits, dynamics.simnorm_dim)

    def _first(self, name: str, on_code: dict[str, Tensor], rest: Tensor) -> Tensor:
        return on_code[name].addmm_(rest, self.weights.heads[name].on_rest)  # asked for once

    def _rewards(self, first: list[Tensor]) -> Tensor:
        """Rewards [H, n] from the first products of every step, as many steps at a time as fit the cache."""
        steps = max(1, self.rows // len(first[0]))
        blocks = [torch.cat(first[t : t + steps]) for t in range(0, len(first), steps)]
        return torch.cat([self._scalars("reward", block) for block in blocks]).view(len(first), -1)

    def _scalars(self, name: str, first: Tensor) -> Tensor:
        return self.weights.two_hot.decode(self.weights.heads[name].finish(first))
