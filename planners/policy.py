"""No search: follow the policy prior."""

from dataclasses import dataclass

import torch
from torch import Tensor

from planners.base import (
    FiniteChecks,
    Model,
    Plan,
    check_discount,
    check_finite,
    imagine_policy,
    imagine_recurrent,
    imagined_return,
)


@dataclass(frozen=True, kw_only=True)
class PolicyPlanner:
    """The policy prior alone, imagined `horizon` steps ahead so that its plan has a value like any other.

    A model's policy with a memory goes before its policy prior.

    Raises:
        ValueError: From the constructor, if a number is out of range.
    """

    action_dim: int
    horizon: int = 4
    discount: float = 0.99

    def __post_init__(self) -> None:
        check_discount(self.discount)
        for name in ("action_dim", "horizon"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: a planner needs at least 1.")

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
        """Mean actions of the prior from z [B, D], or with `explore` the prior's own samples.

        Arguments and errors as `SamplingPlanner.plan`; the plan is its own only candidate.
        """
        checks = FiniteChecks()
        checks.note("latents", z)
        shape = (len(z), self.horizon, self.action_dim)
        noise = torch.randn(shape, generator=generator, device=z.device, dtype=z.dtype) if explore else None
        latents, mean, memory = self._followed(model, z, previous, fresh, noise)
        checks.note_followed(latents, mean)
        value = imagined_return(model, latents, mean, self.discount)
        checks.note("values of the plan", value)
        check_finite(type(self).__name__, checks.names, checks.stacked())
        kept = (mean.unsqueeze(1), value.unsqueeze(1)) if keep_candidates else (None, None)
        return Plan(mean[:, 0], mean, torch.zeros_like(mean), value, *kept, memory=memory)

    def _followed(
        self, model: Model, z: Tensor, previous: Plan | None, fresh: Tensor | None, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Latents [B, H + 1, D] and actions [B, H, A] from z on, and what `Plan.memory` keeps after the first step."""
        if getattr(model, "recurrent_policy", None) is None:
            return *imagine_policy(model, z, noise, self.horizon), None
        begins = torch.zeros(len(z), dtype=torch.bool, device=z.device) if fresh is None else fresh
        before = None if previous is None else previous.memory
        return imagine_recurrent(model, z, before, begins, noise, self.horizon)  # type: ignore[arg-type]
