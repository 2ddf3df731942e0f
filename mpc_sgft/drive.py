"""One real rollout: plan, act, record, and keep what the model imagined at each step for the viewer."""

import time
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.env import ControlEnv
from mpc_sgft.record import Episode, EpisodeWriter
from mpc_sgft.world_model import WorldModel
from planners.base import Plan


class Rollout(NamedTuple):
    """What one real episode of T steps left behind.

    Attributes:
        steps: Transitions, [T].
        qpos: At each observation, [T+1, nq]; None where the backend has none.
        plans: Mean of each step's plan [T, H, A]; None if the episode was read back from a file.
        values: What each plan was expected to return, [T].
        plan_ms: Time each plan took, [T].
        candidates: Of selected steps, (t, plans [N, H, A], values [N]).
        success: Whether the goal held at the end.
        aborted: Why the episode ended before its time, or None.
    """

    steps: TensorDict
    qpos: np.ndarray | None
    plans: Tensor | None
    values: Tensor | None
    plan_ms: np.ndarray | None
    candidates: list[tuple[int, Tensor, Tensor]]
    success: bool
    aborted: str | None


def drive(
    env: ControlEnv,
    model: WorldModel,
    planner: Any,
    path: Path,
    *,
    number: int,
    seed: int,
    noise: float,
    candidate_steps: tuple[int, ...],
) -> Rollout:
    """Run one episode on a backend with a single environment, each step on disk before the next begins.

    Args:
        env: One environment, [1].
        model, planner: What chooses the actions.
        path: MCAP file to write.
        number: Of the rollout, from 1; the episode's number in the data.
        seed: Of the start, the planner and the noise.
        noise: Standard deviation of Gaussian noise added to each action.
        candidate_steps: Steps whose candidate plans are kept.
    """
    task, device = env.task, next(model.parameters()).device
    generator = torch.Generator(device).manual_seed(seed)
    noise_generator = torch.Generator().manual_seed(seed + 1)
    env.set_seed(seed)
    state, plan = env.reset(), None
    first = env.backend.positions()
    rows, plans, values, plan_ms, candidates = [], [], [], [], []
    qpos: list[Any] = [] if first is None else [first]
    aborted, meta = None, {"task": task.name, "seed": seed, "control_dt": task.control_dt, **env.backend.describe()}
    with EpisodeWriter(path, meta) as writer:
        for t in range(task.episode_steps):
            began = time.perf_counter()
            keep = t in candidate_steps
            plan = _plan(model, planner, state["observation"].to(device), plan, generator, keep)
            plan_ms.append(1e3 * (time.perf_counter() - began))
            action = plan.action.cpu() + noise * torch.randn(plan.action.shape, generator=noise_generator)
            state["action"] = action.clamp(-1, 1)
            row, state = _step(env, state, number, t)
            writer.step({**_transition(row, t, task.control_dt), "note": env.backend.note}, env.backend.samples())
            rows.append(row[0])
            plans.append(plan.mean[0].cpu())
            values.append(plan.value[0].cpu())
            if qpos:
                qpos.append(env.backend.positions())
            if keep and plan.candidates is not None and plan.candidate_values is not None:
                candidates.append((t, plan.candidates[0].cpu(), plan.candidate_values[0].cpu()))
            if row["next", "invalid"].item():
                aborted = env.backend.note or "the step is invalid"
            if row["next", "done"].item():
                break
        steps = cast(TensorDict, TensorDict.stack(rows))
        success = bool(steps["next", "success"][-1])
        writer.close({"success": success, "return": float(steps["next", "reward"].sum()), "aborted": aborted})
    return Rollout(
        steps=steps,
        qpos=np.stack(qpos) if qpos else None,
        plans=torch.stack(plans),
        values=torch.stack(values),
        plan_ms=np.array(plan_ms),
        candidates=candidates,
        success=success,
        aborted=aborted,
    )


def from_episode(episode: Episode, number: int) -> Rollout:
    """A rollout from its recording; one that was cut off counts as aborted, and its whole steps are kept.

    Raises:
        ValueError: If not a single step is in it.
    """
    data = episode.transitions
    if not data:
        raise ValueError("the recording holds no step")
    count = len(data["step"])

    def column(key: str, dtype: torch.dtype) -> Tensor:
        return torch.as_tensor(np.asarray(data[key]), dtype=dtype).reshape(count, -1)

    flags = {key: column(key, torch.bool) for key in ("terminated", "truncated", "success", "invalid")}
    following = TensorDict(
        {
            "observation": column("next_observation", torch.float32),
            "reward": column("reward", torch.float32),
            "action_sent": column("action_sent", torch.float32),
            "done": flags["terminated"] | flags["truncated"],
            **flags,
        },
        [count],
    )
    steps = TensorDict(
        {
            "observation": column("observation", torch.float32),
            "action": column("action", torch.float32),
            "episode": torch.full((count,), number),
            "step": torch.arange(count),
            "next": following,
        },
        [count],
    )
    aborted = "cut off" if not episode.complete else (episode.outcome or {}).get("aborted")
    success = bool(episode.complete and flags["success"][-1])
    return Rollout(steps, None, None, None, None, [], success, aborted)


@torch.inference_mode()
def _plan(
    model: WorldModel, planner: Any, observation: Tensor, previous: Plan | None, generator: torch.Generator, keep: bool
) -> Plan:
    return planner.plan(model, model.encode(observation), previous, None, generator, keep_candidates=keep)


def _step(env: ControlEnv, state: TensorDict, number: int, t: int) -> tuple[TensorDict, TensorDict]:
    """One step without automatic reset; the row holds only what the buffer keeps."""
    before = state.select("observation", "action")
    after = env.step(state)["next"]
    before["episode"], before["step"] = torch.tensor([number]), torch.tensor([t])
    before["next"] = after
    return before, after.clone()


def _transition(row: TensorDict, t: int, control_dt: float) -> dict[str, Any]:
    """One control step as the recording wants it."""
    following = row.get("next")
    flat = {key: following[key][0, 0].item() for key in ("reward", "terminated", "truncated", "success", "invalid")}
    return {
        "step": t,
        "time": (t + 1) * control_dt,
        "observation": row["observation"][0].numpy(),
        "next_observation": following["observation"][0].numpy(),
        "action": row["action"][0].numpy(),
        "action_sent": following["action_sent"][0].numpy(),
        **flat,
    }
