"""Where on real data the frozen value can be improved, for those who look; it foretells no success (results/audit)."""

import csv
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from mpc_sgft.learning.shaping import Audit, improvable
from mpc_sgft.learning.world_model import WorldModel


def audit(model: WorldModel, steps: TensorDict, discount: float, *, seed: int) -> Audit:
    """Definition 1 at the states that a rollout [T] arrived in, under the model's dynamics.

    It is not asked of terminal states, which have no value, nor where a sensor failed: margins [T] and actions [T, A]
    are nan there, and the share is of the others.
    """
    device = next(model.parameters()).device
    asked = ~(steps["next", "terminated"] | steps["next", "invalid"])[:, 0].to(device)
    margin = torch.full((len(steps),), torch.nan, device=device)
    action = torch.full((len(steps), model.action_dim), torch.nan, device=device)
    if not asked.any():
        return Audit(margin, float("nan"), action)
    with torch.inference_mode():
        z = model.encode(steps["next", "observation"].to(device)[asked])
    generator = torch.Generator(device).manual_seed(seed)
    found = improvable(model, z, action_dim=model.action_dim, discount=discount, generator=generator)
    margin[asked], action[asked] = found.margin, found.action
    return Audit(margin, found.share, action)


def write_audit(path: Path, rollout: int, steps: TensorDict, margin: Tensor, names: tuple[str, ...]) -> None:
    """Append a row for each state: which rollout and step, what was observed, the margin.

    A negative margin is not improvable, an empty one was not asked.
    """
    fresh = not path.exists() or not path.stat().st_size  # a full disk leaves an empty one
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if fresh:
            writer.writerow(["rollout", "step", *names, "margin"])
        for t, (observation, value) in enumerate(zip(steps["next", "observation"], margin.cpu(), strict=True)):
            writer.writerow(
                [
                    rollout,
                    t + 1,
                    *(f"{x:.4f}" for x in observation[: len(names)].tolist()),
                    "" if value.isnan() else f"{value:.4f}",
                ]
            )
