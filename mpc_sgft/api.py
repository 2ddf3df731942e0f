"""The toolkit from Python: the names of the command line, the objects behind them."""

import torch
from omegaconf import DictConfig

from envs.env import ControlEnv
from mpc_sgft.command import compose
from mpc_sgft.learning.agent import Agent
from mpc_sgft.runs import build
from mpc_sgft.runs.build import make_planner
from mpc_sgft.runs.collect import Score, collect, planner_policy, score

__all__ = ["configure", "load_agent", "make_env", "make_planner", "measure", "plan"]


def configure(*overrides: str, command: str = "deploy") -> DictConfig:
    """The config of a command, checked as on the command line.

    Args:
        overrides: Such as `gap=turned`, `planner.horizon=8`, `checkpoint=runs/push/latest`.
        command: Whose config: deploy, pretrain or evaluate.

    Raises:
        UserError: For a name or value that does not exist, with those that do.
    """
    normalised = [compose.normalise(text) for text in compose.spread(overrides)]
    compose.check(command, normalised, sweep=False)
    return compose.compose(command, normalised, list(overrides))


def make_env(cfg: DictConfig, num_envs: int = 1) -> ControlEnv:
    """The task in simulation, N copies stepped together; a TorchRL environment.

    It has the effects of `gap=`, and where the command draws (pretrain, evaluate) each episode those of `randomize=`.
    """
    return build.make_env(cfg, num_envs, randomised=cfg.command != "deploy")


def load_agent(cfg: DictConfig) -> Agent:
    """The agent of `checkpoint=`, or of the checkpoint that is shipped for the task.

    Raises:
        UserError: If the checkpoint is missing, corrupt, or of another task or size.
    """
    return build.load_agent(cfg)[0]


def plan(cfg: DictConfig, agent: Agent, observation: torch.Tensor, seed: int = 0):
    """Plan from observations [N, O]: a `planners.base.Plan` with action [N, A], mean [N, H, A] and value [N]."""
    planner = build.make_planner(cfg, agent.model.action_dim)
    generator = torch.Generator(agent.device).manual_seed(seed)
    with torch.inference_mode():
        return planner.plan(agent.model, agent.model.encode(observation.to(agent.device)), None, None, generator)


def measure(cfg: DictConfig, agent: Agent, episodes: int = 20, seed: int = 0) -> Score:
    """Success and return of an agent that plans, over episodes with fixed seeds."""
    env = make_env(cfg, episodes)
    planner = build.make_planner(cfg, env.action_dim)
    return score(collect(env, planner_policy(agent.model, planner, seed), seed=seed))
