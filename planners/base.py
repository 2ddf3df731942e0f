"""What a planner imagines with (`Model`), what it returns (`Plan`), and the objective that all planners share.

Letters: B environments, N candidates, K elites, H horizon, A action, D latent.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, cast

import torch
from torch import Tensor

PRECISIONS = ("auto", "float32", "bfloat16")  # of a model's matrix products


class Model(Protocol):
    """A learned world. Every method takes any leading batch dimensions [...]; a class satisfies it by having them.

    On a GPU a plan with an `nn.Module` is recorded: its parameters and buffers are read anew in each plan, everything
    else stays what it was then.

    Attributes:
        value_range: How far apart the values of good and of bad states are, reward units, above 0. Planners measure
            values by it, so that the same settings serve tasks whose rewards are large or small.
    """

    value_range: float

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Latent after `action` [..., A] in latent `z` [..., D]: [..., D]."""
        ...

    def reward(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        """Reward of the transition, [...]. It may be read from the latent it is received in."""
        ...

    def terminal_value(self, z: Tensor) -> Tensor:
        """V(z) of the last imagined latent, reward units, [...]."""
        ...

    def policy_prior(self, z: Tensor, noise: Tensor | None) -> Tensor:
        """Action in [-1, 1], [..., A]; `noise` is standard normal of that shape, None gives the mean action."""
        ...


class QuickModel(Model, Protocol):
    """A model that has a quicker way to the returns of many plans from the same latents than step by step."""

    def plan_values(self, z: Tensor, discount: float, precision: str, rows: int) -> Callable[[Tensor], Tensor]:
        """What gives the `h_step_return` of plans [B, N, H, A] from z [B, D], [B, N], `rows` plans at a time.

        Raises:
            ValueError: If precision is none of PRECISIONS.
        """
        ...


class NeutralModel(Model, Protocol):
    """A model of a machine that zero commands may move."""

    def neutral_action(self) -> Tensor | None:
        """The action in [-1, 1], [A], that the machine turns into what the simulator makes of zero; None: zero."""
        ...


class RecurrentModel(Model, Protocol):
    """A model that also has a policy with a memory.

    Attributes:
        recurrent_policy: That policy; None: there is none.
    """

    recurrent_policy: object | None

    def recurrent_action(
        self, z: Tensor, memory: Tensor | None, begins: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Action as `policy_prior`, [B, A], and the new memory [B, R], after the step before's; None: nothing was seen.

        `begins` [B] bool: episodes that begin here and remember nothing.
        """
        ...


class Plan(NamedTuple):
    """What a planner decided and remembers; pass it back as `previous` to warm-start the next plan.

    Made under `torch.inference_mode`: clone a field before changing it in place or training through it.
    """

    action: Tensor  # what to execute now, [-1, 1]                            [B, A]
    mean: Tensor  # the plan                                                  [B, H, A]
    std: Tensor  # how sure it is of every entry, as the search drew it       [B, H, A]
    value: Tensor  # h_step_return of `mean`, reward units                    [B]
    candidates: Tensor | None = None  # last pool, with keep_candidates       [B, N, H, A]
    candidate_values: Tensor | None = None  # their h_step_return             [B, N]
    memory: Tensor | None = None  # of a policy that has one, after `action`  [B, R]


def h_step_return(model: Model, z: Tensor, actions: Tensor, discount: float) -> Tensor:
    """Discounted reward over the horizon plus a bootstrapped tail.

        G = Σ_{t<H} γᵗ rₜ + γᴴ V(z_H)

    Args:
        model: What to imagine with.
        z: Latent now: one a plan, [..., N, D], or one for all N plans, [..., D].
        actions: Plans in [-1, 1], [..., N, H, A].
        discount: γ in [0, 1], per control step.

    Returns:
        Return of each plan, reward units, [..., N].

    Raises:
        ValueError: If discount is outside [0, 1], or z and actions do not go together.

    Source: TD-MPC2, arXiv:2310.16828, the planning objective, with V(z) for Q(z, π(z)).
    """
    return imagined_return(model, imagine(model, z, actions), actions, discount)


def sgft_objective(model: Model, z: Tensor, actions: Tensor, discount: float) -> Tensor:
    """Discounted sum of the shaped rewards r̄ₜ = rₜ + γ V(zₜ₊₁) - V(zₜ), which telescopes; arguments as `h_step_return`.

        Σ_{t<H} γᵗ r̄ₜ = Σ_{t<H} γᵗ rₜ + γᴴ V(z_H) - V(z₀)

    V(z₀) is the same for all plans of an environment, so planners rank by `h_step_return` alone.

    Source: Yin et al., Rapidly Adapting Policies to the Real World via Simulation-Guided Fine-Tuning, ICLR 2025.
    """
    now = model.terminal_value(z)
    shared = z.dim() == actions.dim() - 2
    return h_step_return(model, z, actions, discount) - (now.unsqueeze(-1) if shared else now)


def plan_values(model: Model, z: Tensor, discount: float, precision: str, rows: int) -> Callable[[Tensor], Tensor]:
    """`QuickModel.plan_values`, or `h_step_return` for a model that has no such thing and only its own precision."""
    if hasattr(model, "plan_values"):
        return cast(QuickModel, model).plan_values(z, discount, precision, rows)
    return step_by_step(model, z, discount, rows)


def step_by_step(model: Model, z: Tensor, discount: float, rows: int) -> Callable[[Tensor], Tensor]:
    """`h_step_return` of plans [B, N, H, A] from z [B, D], `rows` plans at a time on a CPU."""

    def returns(plans: Tensor) -> Tensor:
        starts = z.repeat_interleave(plans.shape[1], 0)
        many = len(starts) if z.is_cuda else rows
        chunks = zip(starts.split(many), plans.flatten(0, 1).split(many), strict=True)
        return torch.cat([h_step_return(model, *chunk, discount) for chunk in chunks]).view(plans.shape[:2])

    return returns


def imagine(model: Model, z: Tensor, actions: Tensor) -> Tensor:
    """Latents that plans [..., H, A] visit from `z` (one a plan, or one for all plans), [..., H + 1, D].

    Raises:
        ValueError: If the leading dimensions of z and actions do not go together.
    """
    if z.dim() == actions.dim() - 2 and z.shape[:-1] == actions.shape[:-3]:
        z = z.unsqueeze(-2).expand(*actions.shape[:-2], -1)
    if z.shape[:-1] != actions.shape[:-2]:
        raise ValueError(
            f"Latents {tuple(z.shape)} do not go with plans {tuple(actions.shape)}: "
            "allowed are [..., N, D] or [..., D] with [..., N, H, A]."
        )
    latents = [z]
    for action in actions.unbind(-2):
        latents.append(model.next(latents[-1], action))
    return torch.stack(latents, -2)


def imagine_policy(model: Model, z: Tensor, noise: Tensor | None, horizon: int) -> tuple[Tensor, Tensor]:
    """Follow the policy prior from `z` [..., D]; noise [..., H, A] or None for its mean action.

    Returns:
        Latents [..., H + 1, D] and actions [..., H, A].
    """
    latents, actions = [z], []
    for t in range(horizon):
        actions.append(model.policy_prior(latents[-1], None if noise is None else noise[..., t, :]))
        latents.append(model.next(latents[-1], actions[-1]))
    return torch.stack(latents, -2), torch.stack(actions, -2)


def imagine_recurrent(
    model: RecurrentModel, z: Tensor, memory: Tensor | None, begins: Tensor, noise: Tensor | None, horizon: int
) -> tuple[Tensor, Tensor, Tensor]:
    """As `imagine_policy` from z [B, D], of the policy with a memory; also its memory after the first step, [B, R]."""
    latents, actions, memories = [z], [], [memory]
    for t in range(horizon):
        drawn = None if noise is None else noise[:, t]
        action, after = model.recurrent_action(latents[-1], memories[-1], begins & (t == 0), drawn)
        actions.append(action)
        memories.append(after)
        latents.append(model.next(latents[-1], action))
    first = memories[1]
    assert first is not None
    return torch.stack(latents, -2), torch.stack(actions, -2), first


def imagined_return(model: Model, latents: Tensor, actions: Tensor, discount: float) -> Tensor:
    """`h_step_return` [...] of plans [..., H, A] whose latents [..., H + 1, D] are already imagined."""
    check_discount(discount)
    horizon = actions.shape[-2]
    rewards = model.reward(latents[..., :-1, :], actions, latents[..., 1:, :])  # [..., H]
    weights = discount ** torch.arange(horizon + 1, device=rewards.device, dtype=rewards.dtype)
    return rewards @ weights[:-1] + weights[-1] * model.terminal_value(latents[..., -1, :])


def check_discount(discount: float) -> None:
    """Raise ValueError unless discount is in [0, 1]."""
    if not 0.0 <= discount <= 1.0:
        raise ValueError(f"discount={discount} is outside [0, 1].")


class FiniteChecks:
    """Notes on the device in which environments something was not finite; the host asks once, when all is computed."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._finite: list[Tensor] = []

    def note(self, what: str, x: Tensor) -> None:
        """Look at x [B, ...]."""
        self.names.append(what)
        self._finite.append(torch.isfinite(x).reshape(len(x), -1).all(1))

    def note_followed(self, latents: Tensor, actions: Tensor) -> None:
        """Look at what `imagine_policy` returned: was it the policy prior or the model that left the finite numbers?"""
        self.note("policy-prior actions", actions[..., :1, :])
        self.note("imagined latents", latents)
        self.note("policy-prior actions", actions)

    def stacked(self) -> Tensor:
        """Whether it was finite, bool [notes, B]."""
        return torch.stack(self._finite)


def check_finite(who: str, names: list[str], finite: Tensor) -> None:
    """Raise FloatingPointError that tells the first of `FiniteChecks` that failed, and in which environments.

    Args:
        who: The planner.
        names, finite: Of the checks, `finite` as `FiniteChecks.stacked`.
    """
    if not finite.all():
        first = int((~finite.all(1)).nonzero()[0])
        bad = (~finite[first]).nonzero().flatten().tolist()
        some = ", ".join(map(str, bad[:8])) + (", ..." if len(bad) > 8 else "")
        raise FloatingPointError(f"{who}: {names[first]} are non-finite (env {some}).")
