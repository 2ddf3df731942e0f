"""A transfer of a small SGFT agent on random rollouts, each addition off unless a test turns it on."""

from pathlib import Path

import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.transfer import Transfer
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.methods.sgft import SGFT
from tests.mpc_sgft.learning.agents import SENSED, SIZES

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
MEMORY = {"memory_dim": 2, "action_dim": 1, "obs_dim": 6, "decode_dim": 2}
TIP = Sensed(SENSED.names[:2], SENSED.starts[:, :2])  # what is observed then


def make_agent(sizes: dict | None = None, **changes) -> Agent:
    torch.manual_seed(0)
    numbers = {k: v for k, v in OmegaConf.load(CONFIGS / "train/default.yaml").agent.items() if k != "_target_"}
    return Agent(WorldModel(**(SIZES | (sizes or {}))), **(numbers | {"discount": 0.9} | changes))


def make_sgft(**changes) -> SGFT:
    plain = {
        "horizon": 2,
        "gate_excess": 0.0,
        "anchor": 0.0,
        "command_map": False,
        "command_band": False,
        "observation_map": False,
        "suspicion_margin": 0.0,
        "lr_decay": 0.0,
        "average_decay": 0.0,
        "policy_share": 1.0,
        "win_stay": 0,
        "slice_len": 2,
    }
    numbers = OmegaConf.load(CONFIGS / "method/sgft.yaml")
    return SGFT(**{k: (plain | changes).get(k, numbers._get_node(k)._value()) for k in numbers if k != "_target_"})


def rollout(model: WorldModel, steps: int = 12, seed: int = 0) -> TensorDict:
    """An episode [T] of random observations."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(steps + 1, model.obs_dim, generator=generator)
    action = 2 * torch.rand(steps, model.action_dim, generator=generator) - 1
    flags = {k: torch.zeros(steps, 1, dtype=torch.bool) for k in ("terminated", "truncated", "done", "invalid")}
    following = {"observation": observation[1:], "reward": torch.zeros(steps, 1), **flags}
    return TensorDict(
        {
            "observation": observation[:-1],
            "action": action,
            "episode": torch.full((steps,), seed),
            "step": torch.arange(steps),
            "next": TensorDict(following, [steps]),
        },
        [steps],
    )


def transfer(
    gate: bool = True, updates: int = 5, margin: float = 0.9, of_method: dict | None = None, **changes
) -> Transfer:
    method = make_sgft(lr=1e-2, gate=gate, updates=updates, gate_margin=margin, **(of_method or {}))
    sensed = TIP if changes.get("sizes") == MEMORY else SENSED
    return Transfer(make_agent(**changes), method, sensed, capacity=200, batch_size=16, seed=0)


def same(a: WorldModel, b: WorldModel) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))
