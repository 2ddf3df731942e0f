"""What MPPI and CEM share: sample plans around a mean, imagine them, move the mean toward the best, and again."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import partial
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from planners.base import (
    PRECISIONS,
    FiniteChecks,
    Model,
    Plan,
    check_discount,
    check_finite,
    h_step_return,
    imagine_policy,
    imagined_return,
    plan_values,
)
from planners.cuda_graph import CudaGraphs, addresses
from planners.neutral import from_neutral, neutral_action, to_neutral


@dataclass(frozen=True, kw_only=True)
class SamplingPlanner(ABC):
    """Iterated sampling over plans [H, A], batched over environments; a concrete planner says how elites weigh.

    Iteration i weighs num_candidates / candidate_decay^i plans: those of the policy prior (imagined and valued once),
    the rest drawn from N(mean, std). It keeps the best, num_elites of num_candidates, and refits

        mean = Σ_k w_k a_k        std = sqrt(Σ_k w_k (a_k - mean)²), clamped to [min_std, max_std]

    With `neutral` all of this is in coordinates whose zero is the model's neutral action (planners/neutral.py).
    configs/planner/<name>.yaml says what every number does.

    Raises:
        ValueError: From the constructor, if a number is out of range.

    Source of the decay: Pinneri et al., Sample-efficient cross-entropy method (iCEM), CoRL 2020.
    """

    action_dim: int
    horizon: int = 4
    num_candidates: int = 512
    num_prior: int = 24
    num_elites: int = 64
    candidate_decay: float = 1.0
    iterations: int = 6
    min_std: float = 0.05
    max_std: float = 2.0
    neutral: bool = True
    discount: float = 0.99
    chunk_rows: int = 1024
    precision: str = "auto"
    cuda_graph: bool = True
    _graphs: WeakKeyDictionary[nn.Module, CudaGraphs] = field(
        default_factory=WeakKeyDictionary, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        check_discount(self.discount)
        for name in ("action_dim", "horizon", "num_candidates", "num_elites", "iterations", "chunk_rows"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: a planner needs at least 1.")
        if not 0 <= self.num_prior < self.num_candidates:
            raise ValueError(f"num_prior={self.num_prior} is outside [0, num_candidates={self.num_candidates}).")
        if self.num_elites > self.num_candidates:
            raise ValueError(f"num_elites={self.num_elites} exceeds num_candidates={self.num_candidates}.")
        if not self.candidate_decay >= 1:
            raise ValueError(f"candidate_decay={self.candidate_decay}: it divides the candidates and is at least 1.")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision={self.precision!r}. Available: {', '.join(PRECISIONS)}.")
        if not 0 < self.min_std <= self.max_std:
            raise ValueError(f"0 < min_std <= max_std does not hold: min_std={self.min_std}, max_std={self.max_std}.")

    def counts(self) -> list[int]:
        """Candidates of each iteration; at least one is drawn."""
        wanted = (round(self.num_candidates * self.candidate_decay**-i) for i in range(self.iterations))
        return [max(self.num_prior + 1, count) for count in wanted]

    @abstractmethod
    def weights(self, values: Tensor) -> Tensor:
        """Weight of every elite from its value in units of the value range, [B, K]; they sum to one."""

    @torch.inference_mode()
    def plan(
        self,
        model: Model,
        z: Tensor,
        previous: Plan | None,
        fresh: Tensor | None,
        generator: torch.Generator,
        keep_candidates: bool = False,
        explore: bool = False,
    ) -> Plan:
        """Plan from the latents z [B, D].

        Args:
            model: What to imagine with, on the device of z.
            z: Latent of every environment, [B, D].
            previous: The last plan, whose mean, shifted by one step, is where the search starts; None starts at zero,
                or at the neutral action.
            fresh: True where an episode just started and `previous` is forgotten, bool [B]; None for nowhere.
            generator: Source of all randomness, on the device of z.
            keep_candidates: Also return the last pool of candidates and their values.
            explore: Execute a sample around the mean instead of the mean.

        Raises:
            FloatingPointError: If latents, policy prior, candidate values or the plan are not finite; the message says
                which, and in which environments.
            ValueError: If `previous` belongs to other sizes.
        """
        neutral = neutral_action(model) if self.neutral else None
        mean = self._warm_start(z, previous, fresh, neutral)  # [B, H, A]
        inputs = [z, mean] if neutral is None else [z, mean, neutral]
        if self.cuda_graph and z.is_cuda and isinstance(model, nn.Module):  # whose tensors can be found
            plan, names, finite = self._replayed(model, generator, inputs, keep_candidates, explore)
        else:
            plan, names, finite = self._search(model, keep_candidates, explore, generator, *inputs)
        check_finite(type(self).__name__, names, finite)
        return plan

    def _search(
        self,
        model: Model,
        keep_candidates: bool,
        explore: bool,
        generator: torch.Generator,
        z: Tensor,
        mean: Tensor,
        neutral: Tensor | None = None,
    ) -> tuple[Plan, list[str], Tensor]:
        """Search around `mean` [B, H, A]: the plan, and what was looked at on the way, as `check_finite` takes it.

        `mean` and all that is drawn are as `planners.neutral.to_neutral` has them.
        """
        checks, prior = FiniteChecks(), self.num_prior
        checks.note("latents", z)
        std = torch.full_like(mean, self.max_std)
        pool = z.new_empty(len(z), self.num_candidates, self.horizon, self.action_dim)
        values = z.new_empty(len(z), self.num_candidates)
        if prior:
            noise = torch.randn(pool[:, :prior].shape, generator=generator, device=z.device, dtype=z.dtype)
            start = z.unsqueeze(1).expand(-1, prior, -1)
            latents, actions = imagine_policy(model, start, noise, self.horizon)
            checks.note_followed(latents, actions)
            pool[:, :prior] = to_neutral(actions, neutral)
            values[:, :prior] = imagined_return(model, latents, actions, self.discount)

        returns = plan_values(model, z, self.discount, self.precision, self.chunk_rows)
        for count in self.counts():
            pool, values = pool[:, :count], values[:, :count]
            noise = torch.empty_like(pool[:, prior:]).normal_(generator=generator)
            pool[:, prior:] = torch.addcmul(mean.unsqueeze(1), std.unsqueeze(1), noise).clamp_(-1, 1)
            values[:, prior:] = returns(from_neutral(pool[:, prior:], neutral))
            checks.note("candidate values", values)
            mean, std = self.refit(pool, values / model.value_range)
        plan = from_neutral(mean, neutral)
        checks.note("planned actions", plan)
        value = h_step_return(model, z, plan.unsqueeze(1), self.discount).squeeze(1)
        checks.note("values of the plan", value)
        action = plan[:, 0]
        if explore:
            draw = torch.randn(action.shape, generator=generator, device=z.device, dtype=z.dtype)
            action = from_neutral((mean[:, 0] + std[:, 0] * draw).clamp(-1, 1), neutral)
        kept = (from_neutral(pool, neutral), values) if keep_candidates else (None, None)
        return Plan(action, plan, std, value, *kept), checks.names, checks.stacked()

    def _replayed(
        self,
        model: Model,
        generator: torch.Generator,
        inputs: list[Tensor],
        keep_candidates: bool,
        explore: bool,
    ) -> tuple[Plan, list[str], Tensor]:
        """`_search` as one CUDA graph for each model, as long as its tensors stay where they are."""
        assert isinstance(model, nn.Module)
        graphs = self._graphs.setdefault(model, CudaGraphs())
        shapes = tuple(x.shape for x in inputs)
        key = (shapes, keep_candidates, explore, model.value_range, model.training, addresses(model))
        search = partial(self._search, model, keep_candidates, explore)
        plan, names, finite = graphs(key, search, inputs, generator)
        copies = {name: x.clone() for name, x in plan._asdict().items() if x is not None}
        return Plan(**copies), names, finite

    def refit(self, pool: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and clamped std of the elites, each [B, H, A], from candidates [B, N, H, A] and their values [B, N].

        Values are in units of the model's `value_range`. Of fewer candidates fewer are elites, in proportion.
        """
        elites = math.ceil(self.num_elites * values.shape[1] / self.num_candidates)
        top, index = values.topk(elites, dim=1)
        best = pool.gather(1, index[..., None, None].expand(-1, -1, *pool.shape[2:]))  # [B, K, H, A]
        weight = self.weights(top)[..., None, None]
        mean = (weight * best).sum(1).clamp(-1, 1)  # rounding may leave [-1, 1]
        variance = (weight * (best - mean.unsqueeze(1)).square()).sum(1)
        return mean, variance.sqrt().clamp(self.min_std, self.max_std)

    def _warm_start(self, z: Tensor, previous: Plan | None, fresh: Tensor | None, neutral: Tensor | None) -> Tensor:
        """The previous mean one step on, zero where an episode just started, [B, H, A], as `to_neutral` has it."""
        mean = z.new_zeros(len(z), self.horizon, self.action_dim)
        if previous is None:
            return mean
        if previous.mean.shape != mean.shape:
            raise ValueError(
                f"The previous plan is {tuple(previous.mean.shape)}, this one {tuple(mean.shape)} (environments, "
                "horizon, action entries): start with previous=None where one of them changes."
            )
        mean[:, :-1] = to_neutral(previous.mean[:, 1:], neutral)
        return mean if fresh is None else mean.masked_fill_(fresh.view(-1, 1, 1), 0)
