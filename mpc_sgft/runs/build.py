"""From a config to the objects that all loops share: environments, planners, agents."""

import copy
import logging
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import mpc_sgft
from envs import effects, randomize
from envs.backends.sim import SimBackend
from envs.env import ControlEnv
from mpc_sgft.command.errors import UserError, from_config
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.beta import quantile
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.storage import checkpoint
from planners.exploring import ExploringPlanner
from planners.malloc import keep_freed_memory
from planners.policy import PolicyPlanner

if TYPE_CHECKING:
    from mpc_sgft.learning.doraemon import Doraemon  # only where it is asked for: its solver takes time to import

STARTS = 64  # simulated episodes whose starts tell where real ones should


def device(cfg: DictConfig) -> torch.device:
    """The device that `device=` asks for; auto takes CUDA where there is one.

    Raises:
        UserError: If CUDA is asked for and absent.
    """
    if cfg.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda, but PyTorch finds no CUDA device here. Use device=cpu or device=auto.")
    return torch.device("cuda" if cfg.device != "cpu" and torch.cuda.is_available() else "cpu")


def prepare_process(cfg: DictConfig) -> None:
    """Threads and memory of this process, for speed; call once at the start."""
    torch.set_num_threads(cfg.torch_threads)
    keep_freed_memory()
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces every buffer it creates


def make_env(
    cfg: DictConfig, num_envs: int, *, randomised: bool = False, learning: bool = False, threads: int = 0
) -> ControlEnv:
    """The task in simulation with the effects of `cfg.gap`.

    Args:
        cfg: The run's config.
        num_envs: Copies stepped side by side [N].
        randomised: Each episode draws its own model.
        learning: The episodes are learned from, not measured: they start as `cfg.task.in_training` says.
        threads: Of the physics; 0 takes all cores.

    Raises:
        UserError: For an unknown effect, a parameter out of bounds, a draw that names nothing, or missing physics.
    """
    with from_config("task"):
        differs = cfg.task.get("in_training") or {} if learning else {}
        task = instantiate({**cfg.task.env, **differs}, _convert_="all")
    noise = {}
    with from_config("gap"):
        present = effects.load(OmegaConf.to_container(cfg.gap.effects, resolve=True))  # type: ignore[arg-type]
    with from_config("randomize"):
        draws = []
        if randomised:
            draws = list(draws_of(cfg).values())
            noise = {"noise_sd": cfg.randomize.noise_sd, "noise_probability": cfg.randomize.noise_probability}
    reward = {"reward": cfg.backend.reward} if "reward" in cfg.get("backend", {}) else {}
    with from_config("simulation"):
        how = {"threads": threads, "physics": cfg.physics, **noise, **reward}
        backend = SimBackend(task, num_envs, effects=present, draws=draws, **how)
    known = backend.privileged if learning and cfg.train.privileged else None
    return ControlEnv(backend, history=cfg.task.history, privileged=known)


def draws_of(cfg: DictConfig) -> dict[str, randomize.Draw]:
    """The draws of `cfg.randomize` by their names; one that is null is left out.

    Raises:
        ValueError: For one that is not allowed.
    """
    entries = OmegaConf.to_container(cfg.randomize.draws, resolve=True)
    entries = {name: draw for name, draw in entries.items() if draw is not None}  # type: ignore[union-attr]
    draws = randomize.load(entries)  # type: ignore[arg-type]
    return dict(zip(entries, draws, strict=True))  # type: ignore[arg-type]


def load_state(path: Path) -> dict[str, Any]:
    """The exact state of a run that is resumed.

    Raises:
        UserError: If it is damaged.
    """
    try:
        return checkpoint.load_state(path)
    except checkpoint.CheckpointError as error:
        raise UserError(str(error)) from error


def make_curriculum(cfg: DictConfig) -> "Doraemon | None":
    """What widens the ranges of `cfg.randomize` while pretraining goes on; None if nothing does.

    Raises:
        UserError: For a number that it refuses, or without anything that is randomised.
    """
    if cfg.curriculum.get("_target_") is None:
        return None
    with from_config("curriculum"):
        return instantiate(cfg.curriculum, draws=len(draws_of(cfg)))


def drawn_ranges(draws: Mapping[str, randomize.Draw], shapes: Tensor) -> dict[str, list[float]]:
    """Of each draw, where 90 % of what the Beta distributions [D, 2] draw lies, {name: [from, to]}, its own unit."""
    ends = quantile(shapes, torch.tensor([[0.05], [0.95]], dtype=torch.float64)).T  # [D, 2]
    return {
        name: [float(f"{draw.value(x):.5g}") for x in places]
        for (name, draw), places in zip(draws.items(), ends.tolist(), strict=True)
    }


def sensed(cfg: DictConfig) -> Sensed:
    """What the task observes, and where its episodes start in simulation, without the gap."""
    plain = copy.deepcopy(cfg)
    OmegaConf.update(plain, "gap.effects", {}, merge=False)
    env = make_env(plain, STARTS)
    with closing(env.backend):
        env.set_seed(cfg.seed)
        starts = env.reset()["observation"][:, : env.raw_dim]
    return Sensed(tuple(env.task.observation_names), starts)


def make_planner(cfg: DictConfig, action_dim: int):
    """The planner of `cfg.planner`.

    Raises:
        UserError: For a number that the planner refuses.
    """
    with from_config("planner"):
        return instantiate(cfg.planner, action_dim=action_dim, discount=cfg.task.discount, _convert_="all")


def make_warm_up(cfg: DictConfig, env: ControlEnv) -> PolicyPlanner | ExploringPlanner:
    """What drives the first real rollouts: the policy prior, pushed as `cfg.exploration` says.

    Raises:
        UserError: For offsets that do not fit the task, or that would not be driven.
    """
    how = {"action_dim": env.action_dim, "horizon": cfg.planner.horizon, "discount": cfg.task.discount}
    pushes = OmegaConf.to_container(cfg.exploration, resolve=True) if "exploration" in cfg else {}
    assert isinstance(pushes, dict)
    if not pushes.get("offsets"):  # deployments of before, which --retrain repeats, say nothing of it
        if pushes.get("weight", 1.0) != 1.0:
            raise UserError(
                f"exploration.weight={pushes['weight']} goes with exploration.offsets. Give them, or neither."
            )
        return PolicyPlanner(**how)
    if cfg.warmup < 1:
        raise UserError("exploration.offsets drive the warm-up, and warmup=0. Give warmup=N, the rollouts driven so.")
    with from_config("exploration"):
        return ExploringPlanner(**how, **pushes, steps=env.task.episode_steps)  # type: ignore[arg-type]


def make_agent(cfg: DictConfig, env: ControlEnv) -> Agent:
    """A fresh agent of the size `cfg.model` for an environment's observation and action."""
    torch.manual_seed(cfg.seed)
    with from_config("model"):
        sizes = {"obs_dim": env.obs_dim, "action_dim": env.action_dim, "decode_dim": env.raw_dim}
        model = instantiate(cfg.model, memory_dim=env.history * env.action_dim, **sizes)
    with from_config("train"):
        return instantiate(cfg.train.agent, model=model, seed=cfg.seed, device=device(cfg), discount=cfg.task.discount)


def load_agent(cfg: DictConfig) -> tuple[Agent, dict[str, Any]]:
    """The agent of `cfg.checkpoint`, or of the shipped checkpoint, and the checkpoint's header.

    Raises:
        UserError: If the checkpoint is missing, corrupt, of another task, or of another size than a `model=` that was
            asked for; if its policy has a memory that nothing here follows; or if `train=` would begin it anew.
    """
    if cfg.train.get("privileged") and cfg.command != "pretrain":
        raise UserError(f"train={cfg.chosen.train} begins a policy anew: it is for pretrain. Leave it out here.")
    path = cfg.checkpoint if cfg.checkpoint is not None else shipped(agents_of(cfg))
    tasks = [cfg.chosen.task, agents_of(cfg)]
    asked = any(text.startswith("model") for text in cfg.overrides)
    sizes = OmegaConf.to_container(cfg.model, resolve=True) if asked else {}
    assert isinstance(sizes, dict)
    sizes.pop("_target_", None)
    try:
        loaded = checkpoint.load(path, tasks=tasks, sizes=sizes, device=device(cfg))  # type: ignore[arg-type]
    except checkpoint.CheckpointError as error:
        raise UserError(str(error)) from error
    for name in ("history", "discount"):
        if loaded.meta[name] != cfg.task[name]:
            raise UserError(
                f"{path} was trained with task.{name}={loaded.meta[name]}, this run has {cfg.task[name]}. "
                f"Leave task.{name} out, or pretrain again."
            )
    pushed = OmegaConf.select(cfg, "exploration.offsets")
    if loaded.model.recurrent_policy is not None and (cfg.chosen.planner != "policy" or _learns(cfg) or pushed):
        raise UserError(
            f"{path} has a policy with a memory, which only planner=policy follows, and which nothing trains any "
            "further. Use method=zero_shot planner=policy, without exploration."
        )
    torch.manual_seed(cfg.seed)  # of dropout, and of what a method adds to the model
    with from_config("train"):
        agent = instantiate(
            cfg.train.agent, model=loaded.model, seed=cfg.seed, device=device(cfg), discount=cfg.task.discount
        )
    return agent, loaded.meta


def _learns(cfg: DictConfig) -> bool:
    """Whether something trains what is loaded: pretraining, or a deployment's method."""
    return cfg.command == "pretrain" or ("method" in cfg and cfg.method.get("updates", 0) > 0)


def agents_of(cfg: DictConfig) -> str:
    """The task whose pretrained agents this one takes, too: a variant of it has the same observations and actions."""
    return cfg.task.get("agents_of") or cfg.chosen.task


def check_fits(model: WorldModel, env: ControlEnv) -> None:
    """Refuse a checkpoint whose sizes are not those of the environment.

    Raises:
        UserError: With what was expected and found.
    """
    for name, here in (("obs_dim", env.obs_dim), ("action_dim", env.action_dim), ("decode_dim", env.raw_dim)):
        if model.sizes[name] != here:
            raise UserError(
                f"the checkpoint has {name}={model.sizes[name]}, this task has {here} (task.env.control, task.history?)"
            )


def shipped(task: str) -> Path:
    """The checkpoint that comes with the package for a task.

    Raises:
        UserError: If there is none.
    """
    folder = Path(mpc_sgft.__file__).parent / "assets"
    path = folder / f"{task}.safetensors"
    if not path.is_file():
        have = ", ".join(sorted(p.stem for p in folder.glob("*.safetensors"))) or "none"
        raise UserError(f"no checkpoint is shipped for task {task!r} (shipped: {have}). Give checkpoint=RUN_FOLDER.")
    return path
