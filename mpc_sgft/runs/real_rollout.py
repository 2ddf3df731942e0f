"""One real rollout: plan, act, record, and keep what the model imagined at each step for the viewer."""

import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.env import ControlEnv
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.session.operator import Nobody, Operator
from mpc_sgft.storage.episode_file import EpisodeWriter
from mpc_sgft.storage.rollout import Rollout
from planners.base import Plan

REAL_SEED = 2_000_000  # of real rollouts: far from evaluation, and from what a pretraining with seed=0 collects


def start_seed(seed: int, number: int) -> int:
    """Seed of the start of rollout `number`, from 1, of a run with a seed."""
    return REAL_SEED + 1000 * seed + number


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
    operator: Operator | None = None,
    state: TensorDict | None = None,
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
        operator: Who watches; nobody if None.
        state: First observation of an episode that `begin` began; None begins it here.
    """
    operator = operator or Nobody()
    task, device = env.task, next(model.parameters()).device
    generator = torch.Generator(device).manual_seed(seed)
    noise_generator = torch.Generator().manual_seed(seed + 1)
    state = begin(env, seed) if state is None else state
    plan: Plan | None = None
    first = env.backend.positions()
    rows, plans, values, plan_ms, candidates = [], [], [], [], []
    qpos: list[Any] = [] if first is None else [first]
    aborted, keys, meta = None, [], {"task": task.name, "seed": seed, "control_dt": task.control_dt}
    meta |= {"began_unix": time.time(), **env.backend.describe()}

    def listen(writer: EpisodeWriter) -> None:
        for press in operator.poll():
            keys.append(press)
            writer.key(press.word, time=press.unix - meta["began_unix"], unix=press.unix)

    with EpisodeWriter(path, meta) as writer:
        operator.enter("running", number)
        for t in range(task.episode_steps):
            began = time.perf_counter()
            keep = t in candidate_steps
            plan = _plan(model, planner, state["observation"].to(device), plan, generator, keep)
            plan_ms.append(1e3 * (time.perf_counter() - began))
            action = plan.action.cpu() + noise * torch.randn(plan.action.shape, generator=noise_generator)
            state["action"] = action.clamp(-1, 1)
            row, state = _step(env, state, number, t)
            samples = env.backend.samples()
            nominal = (t + 1) * task.control_dt
            end = nominal if samples is None else float(samples["time"][-1])  # a robot may have waited
            writer.step({**_transition(row, t, end), "note": env.backend.note}, samples)
            listen(writer)
            operator.tell(step=f"{t + 1} of {task.episode_steps}", note=env.backend.note)
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
        while aborted and operator.guiding:
            writer.guided(env.backend.guided())
            listen(writer)
        operator.enter("ending", number)  # nothing can be taken over from here on
        listen(writer)
        steps = cast(TensorDict, TensorDict.stack(rows))
        intervened = aborted is not None and any(press.word == "takeover" for press in keys)
        success = bool(steps["next", "success"][-1])
        outcome = {"success": success, "return": float(steps["next", "reward"].sum()), "aborted": aborted}
        writer.close(outcome | {"intervened": intervened})
    return Rollout(
        steps=steps,
        qpos=np.stack(qpos) if qpos else None,
        plans=torch.stack(plans),
        values=torch.stack(values),
        plan_ms=np.array(plan_ms),
        candidates=candidates,
        success=success,
        aborted=aborted,
        keys=tuple(keys),
        intervened=intervened,
    )


def begin(env: ControlEnv, seed: int) -> TensorDict:
    """Start an episode: its first observation."""
    env.set_seed(seed)
    return env.reset()


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


def _transition(row: TensorDict, t: int, end: float) -> dict[str, Any]:
    """One control step as the recording wants it; `end` [s] since the episode's start."""
    following = row.get("next")
    flat = {key: following[key][0, 0].item() for key in ("reward", "terminated", "truncated", "success", "invalid")}
    return {
        "step": t,
        "time": round(end, 9),
        "observation": row["observation"][0].numpy(),
        "next_observation": following["observation"][0].numpy(),
        "action": row["action"][0].numpy(),
        "action_sent": following["action_sent"][0].numpy(),
        **flat,
    }
