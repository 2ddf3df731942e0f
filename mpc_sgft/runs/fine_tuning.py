"""A pretrained agent in the hands of a method that fine-tunes it."""

from collections.abc import Callable
from functools import partial

from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDict

from mpc_sgft.command.errors import UserError, from_config
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.transfer import Transfer
from mpc_sgft.runs.explore import explored


def make_transfer(
    cfg: DictConfig,
    agent: Agent,
    sensed: Sensed,
    episode_steps: int,
    simulated: Callable[[int], TensorDict] | None = None,
) -> Transfer:
    """A pretrained agent in the hands of `cfg.method`; simulated episodes are those of pretraining, if not given.

    Raises:
        UserError: For a number that the method refuses, or where it learns and no episode holds one of its slices.
    """
    with from_config("method"):
        method = instantiate(cfg.method, _convert_="all")
    if method.updates and not 1 <= method.slice_len <= episode_steps:
        raise UserError(
            f"method.slice_len={method.slice_len}: an episode of {episode_steps} steps holds no such slice. "
            f"Give 1 to {episode_steps}."
        )
    return Transfer(
        agent,
        method,
        sensed,
        capacity=(cfg.rollouts + 1) * episode_steps,
        batch_size=cfg.train.replay.batch_size,
        seed=cfg.seed,
        simulated=simulated or partial(explored, cfg, agent.model),
    )
