"""The pretraining loop: collect a round of randomised episodes, learn from the buffer, measure, save."""

import json
import os
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from envs.backends.sim import cores
from envs.env import ControlEnv
from mpc_sgft.command.errors import Stopped, UserError, disk_errors, from_config
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.buffer import SliceBuffer
from mpc_sgft.learning.row_buffer import RowBuffer
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import Act, collect, planner_policy, score, shown, succeeded
from mpc_sgft.runs.explore import Collected, Round, check_exploration, policy_weights
from mpc_sgft.storage import checkpoint, run_folder
from mpc_sgft.storage.metrics import MetricLogger, progress
from planners.policy import PolicyPlanner

EVAL_SEED = 1_000_000  # of evaluation episodes: far from what a pretraining with seed=0 collects


def pretrain(cfg: DictConfig) -> int:
    """Pretrain until the target success is held or the transitions are spent; returns the exit code."""
    folder = run_folder.start(cfg)
    go_on = f"python -m mpc_sgft.pretrain --resume {folder}"
    with disk_errors(lambda: f"Make room. What was saved is whole. Go on: {go_on}"):
        return _pretrain(cfg, folder, go_on)


def _pretrain(cfg: DictConfig, folder: Path, go_on: str) -> int:
    """As `pretrain`, in its folder; `go_on` is the command that continues."""
    build.prepare_process(cfg)
    check_exploration(cfg)
    judge = build.make_env(cfg, cfg.eval_episodes, randomised=True)
    agent = start_agent(cfg, judge)
    round_size = cfg.num_envs * judge.task.episode_steps
    if not cfg.train.privileged:
        agent.imagined_steps = cfg.imagined_steps
    curriculum = build.make_curriculum(cfg)
    planner = build.make_planner(cfg, judge.action_dim)  # what is wrong with it shows now, not after hours
    buffer = start_buffer(cfg, agent.device, judge.task.episode_steps)
    state = {"round": 0, "updates": 0, "transitions": 0, "episodes": 0, "seconds": 0.0, "streak": 0, "unstable": 0}
    watch = Stopwatch("wait", "update", "evaluate", "save", "act", "physics")  # the last two are the collectors' own
    saved = folder / "checkpoint" / "state.pt"
    stored = build.load_state(saved) if cfg.resume is not None and saved.is_file() else None
    if stored is not None:
        state, watch.spent = stored["loop"], watch.spent | stored["spent"]
        agent.load_state_dict(stored["agent"])
        agent.averaged.value_range = float(agent.scale.value)
        buffer.load_state_dict(stored["buffer"])
        if curriculum is not None:
            curriculum.load_state_dict(stored["curriculum"])
    with from_config("collector"):
        collector = instantiate(cfg.collector, _partial_=True)(cfg=cfg, sizes=agent.model.sizes)

    def plan_round(number: int) -> Round:
        """A round for the policy of now; the first ones act at random."""
        at_random = number * round_size < cfg.random_transitions
        shapes = None if curriculum is None else tuple(map(tuple, curriculum.shapes.tolist()))
        return Round(number, None if at_random else policy_weights(agent.model), shapes)

    def finished() -> bool:
        """Whether the transitions are spent, or the target success was held."""
        held = state["streak"] >= cfg.target_streak and state["transitions"] >= cfg.min_transitions
        return held or state["transitions"] >= cfg.transitions

    def save() -> None:
        """Weights and exact state, at the end of a round."""
        agent.averaged.value_range = float(agent.scale.value)
        meta = checkpoint.describe(cfg, agent.averaged, extra={"transitions": state["transitions"]})
        checkpoint.save(folder / "checkpoint" / "model.safetensors", agent.averaged, meta)
        ahead = collector.result().state_dict() if state["transitions"] < cfg.transitions else None
        parts = {"loop": state, "spent": watch.spent, "order": tuple(order), "ahead": ahead}
        parts["curriculum"] = None if curriculum is None else curriculum.state_dict()
        checkpoint.save_state(saved, {**parts, "agent": agent.state_dict(), "buffer": buffer.state_dict()})

    stop = StopRequest("round")
    logger = MetricLogger(
        folder,
        csv=cfg.log.csv,
        tensorboard=cfg.log.tensorboard,
        wandb=cfg.log.wandb,
        resume_step=state["transitions"] if cfg.resume is not None else None,
    )
    run_folder.keep_told(cfg, folder)
    bar = progress(cfg.transitions, initial=state["transitions"], desc="pretrain", disable=cfg.quiet)
    result, began = None, time.monotonic() - state["seconds"]
    order, ahead = plan_round(0), None
    if stored is not None:
        order, ahead = Round(*stored["order"]), stored["ahead"] and Collected.of(stored["ahead"])
    elif cfg.resume is not None:
        print(f"{folder} stopped before it saved anything: it begins again")
    if finished():
        print(
            f"{folder} is finished: only its final evaluation is made. More training: transitions=N min_transitions=N"
        )
    elif ahead is None:
        with watch("wait"):
            collector.start(order)
    while not finished():
        with watch("wait"):
            found, ahead = ahead or collector.result(), None
        data = found.steps.clone(recurse=False)
        data["episode"] = data["episode"] + state["episodes"]
        buffer.extend(data)
        state["transitions"] += data.numel()
        state["episodes"] = int(data["episode"].max()) + 1
        state["unstable"] += found.unstable
        for part, seconds in found.seconds.items():
            watch.spent[part] += seconds
        widened = curriculum.record(found.places, succeeded(data), found.shapes) if curriculum and found.shapes else {}
        order = plan_round(state["round"] + 1)
        if state["transitions"] < cfg.transitions:
            with watch("wait"):
                collector.start(order)  # `collector=inline` collects here
        metrics: dict[str, float] = {"train_success": score(data).success, **widened}
        agent.scale_learning_rates(0.5 ** (state["transitions"] / cfg.lr_halves_every))
        if cfg.hold_value:
            agent.hold_value(state["transitions"] <= cfg.hold_value)
        owed = int(state["transitions"] * cfg.updates_per_transition) - state["updates"]
        with watch("update"):
            for left in reversed(range(owed)):
                metrics |= agent.update(buffer.sample(), read=left < cfg.train.agent.policy_delay)
        state["updates"] += owed
        state["round"] += 1
        if state["round"] % cfg.eval_every == 0 or state["transitions"] >= cfg.transitions:
            with watch("evaluate"):
                result = score(collect(judge, prior(agent), seed=EVAL_SEED))
            metrics |= {"success": result.success, "return": result.episode_return}
            state["streak"] = state["streak"] + 1 if result.success >= cfg.target_success else 0
        state["seconds"] = time.monotonic() - began
        counts = {name: state[name] for name in ("unstable", "seconds")}
        logger.log(state["transitions"], {"updates": state["updates"], **metrics, **counts})
        bar.update(state["transitions"] - bar.n)
        bar.set_postfix(success=f"{result.success:.0%}" if result else "-", loss=f"{metrics.get('loss', 0):.2f}")
        if stop.asked or finished() or state["round"] % cfg.save_every == 0:
            with watch("save"):
                save()
        if stop.asked:
            collector.close()
            raise Stopped(f"saved after {state['transitions']} transitions. Go on: {go_on}")
    collector.close()
    bar.close()
    stop.restore()
    if stop.asked:  # while it saved
        raise Stopped(f"saved after {state['transitions']} transitions. Only its final evaluation is left: {go_on}")
    final_judge = build.make_env(cfg, cfg.final_episodes, randomised=True)
    torch.set_num_threads(max(cfg.torch_threads, free_threads()))  # nothing else works now
    policies = [prior(agent)]
    if cfg.chosen.planner != "policy":
        policies.append(planner_policy(agent.averaged, planner, cfg.seed))
    steps = len(policies) * final_judge.task.episode_steps
    with watch("evaluate"), progress(steps, desc="evaluate", disable=cfg.quiet) as bar:
        scores = [score(collect(final_judge, shown(act, bar), seed=EVAL_SEED + 1)) for act in policies]
    final, planned = scores[0], scores[-1]
    torch.set_num_threads(cfg.torch_threads)
    summary = {
        "task": cfg.chosen.task,
        "seed": cfg.seed,
        "transitions": state["transitions"],
        "updates": state["updates"],
        "episodes_evaluated": final.episodes,
        "success": planned.success,
        "success_interval": [planned.success_low, planned.success_high],
        "prior_success": final.success,
        "return": planned.episode_return,
        "unstable_episodes": state["unstable"],
        "wall_seconds": round(time.monotonic() - began, 1),
        "randomize": None if curriculum is None else build.drawn_ranges(build.draws_of(cfg), curriculum.shapes),
        "peak_memory_mb": peak_memory_mb(),
        "seconds": watch.rounded(),
        "checkpoint": str(folder / "checkpoint" / "model.safetensors"),
    }
    run_folder.write_summary(folder, summary)
    logger.close()
    print(json.dumps(summary))
    return 0


def start_buffer(cfg: DictConfig, device: torch.device, episode_steps: int) -> SliceBuffer | RowBuffer:
    """An empty replay buffer.

    Raises:
        UserError: If it cannot hold a round, or no episode holds one of its slices, or its rows are not of a round.
    """
    replay, steps = cfg.train.replay, cfg.num_envs * episode_steps
    if steps > replay.capacity:
        raise UserError(
            f"num_envs={cfg.num_envs}: a round of {steps} transitions does not fit train.replay.capacity="
            f"{replay.capacity}. Give more capacity, or fewer environments."
        )
    if not 1 <= replay.slice_len <= episode_steps:
        raise UserError(f"train.replay.slice_len={replay.slice_len}: an episode has 1 to {episode_steps} steps.")
    if cfg.train.privileged and replay.slice_len != episode_steps:
        raise UserError(
            f"train.replay.slice_len={replay.slice_len}: train={cfg.chosen.train} learns from rows of whole episodes, "
            f"{episode_steps} steps. Leave it out."
        )
    return instantiate(replay, seed=cfg.seed, device=device)


def evaluation_seed(cfg: DictConfig) -> int:
    """Of the evaluation episodes that `eval_seed` chooses, downwards from those of pretraining."""
    return EVAL_SEED - 10 * cfg.eval_seed


def start_agent(cfg: DictConfig, env: ControlEnv) -> Agent:
    """A fresh agent, or that of `checkpoint=` to go on from with new data; of `train.privileged` always the latter.

    Raises:
        UserError: If the checkpoint does not fit, or was changed by a deployment.
    """
    if cfg.checkpoint is None and not cfg.train.privileged:
        return build.make_agent(cfg, env)
    if cfg.train.privileged and (cfg.imagined_steps or cfg.hold_value):
        raise UserError(
            f"imagined_steps={cfg.imagined_steps} and hold_value={cfg.hold_value} are for the world model, which "
            f"train={cfg.chosen.train} leaves as it is. Leave them out."
        )
    agent, meta = build.load_agent(cfg)
    build.check_fits(agent.model, env)
    changed = [part for part in ("command_map", "residual") if meta.get(part)]
    if changed:
        raise UserError(
            f"checkpoint={cfg.checkpoint} comes from a deployment (it has a {changed[0]}): pretraining goes on from "
            "pretrained checkpoints. Give the one that the deployment started from."
        )
    if cfg.imagined_steps:  # then it is only saved; where the policy climbs the critics it scales its loss
        agent.scale.value.fill_(agent.model.value_range)
    return agent


def prior(agent: Agent) -> Act:
    """The mean action of the averaged policy prior."""
    return planner_policy(agent.averaged, PolicyPlanner(action_dim=agent.model.action_dim, horizon=1), 0)


def free_threads() -> int:
    """Threads for what has the machine to itself: one a core, or as many as OMP_NUM_THREADS allows."""
    allowed = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores(), int(allowed)) if allowed.isdecimal() and int(allowed) else cores()


def peak_memory_mb() -> dict[str, int]:
    """Most memory [MB] that this process, and the largest one that it started and that has ended, ever held."""
    unit = 1e6 if sys.platform == "darwin" else 1e3
    kinds = {"learner": resource.RUSAGE_SELF, "collector": resource.RUSAGE_CHILDREN}
    return {name: round(resource.getrusage(kind).ru_maxrss / unit) for name, kind in kinds.items()}


class Stopwatch:
    """Adds up the seconds that the parts of a loop take."""

    def __init__(self, *parts: str) -> None:
        self.spent = dict.fromkeys(parts, 0.0)

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.spent[part] += time.monotonic() - start

    def rounded(self) -> dict[str, float]:
        """Seconds by part, for a summary."""
        return {part: round(seconds, 1) for part, seconds in self.spent.items()}


class StopRequest:
    """Ctrl-C asks a loop to stop at the end of its round or rollout; a second one stops at once."""

    def __init__(self, unit: str) -> None:
        self.asked, self.unit = False, unit
        self._before = signal.signal(signal.SIGINT, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        self.restore()
        print(f"\nstopping after this {self.unit}; once more stops at once", flush=True)

    def restore(self) -> None:
        """Ctrl-C does what it did before."""
        signal.signal(signal.SIGINT, self._before)
