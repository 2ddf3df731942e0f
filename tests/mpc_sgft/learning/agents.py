"""Small agents, batches, and what changed, for tests."""

import torch
from tensordict import TensorDict

from mpc_sgft.learning import losses
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.slices import to_slices
from mpc_sgft.learning.world_model import PARTS, WorldModel
from mpc_sgft.methods.sgft import SGFT
from mpc_sgft.methods.tdmpc2 import TDMPC2
from mpc_sgft.methods.zero_shot import ZeroShot

SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)
NUMBERS = dict(
    discount=0.9,
    rho=0.5,
    lr=3e-4,
    encoder_lr_share=0.3,
    grad_clip=20.0,
    consistency_weight=20.0,
    reward_weight=0.1,
    q_weight=0.1,
    value_weight=0.1,
    decoder_weight=1.0,
    target_rate=0.01,
    scale_rate=0.01,
    entropy_coef=0.01,
    average_decay=0.5,
    entropy_lr=1e-3,
)
SHARED = dict(slice_len=3, action_noise=0.0)
NO_GATE = dict(gate=False, gate_margin=0.9, gate_memory=5)
OURS = dict(gate_excess=0.0, anchor=0.0, residual=False, command_map=False, command_sparsity=0.0, command_lr=2e-2)
OURS |= dict(
    command_band=False,
    observation_map=False,
    observation_lr=5e-3,
    suspicion_margin=0.0,
    anchor_decay=1.0,
    start_weight=1.0,
    lr_decay=0.0,
    average_decay=0.0,
    policy_share=1.0,
    win_stay=0,
)
SENSED = Sensed(("tip_x", "tip_y", "height"), torch.zeros(2, 3))
SGFT_NUMBERS = dict(
    horizon=4, lr=3e-4, policy_lr=3e-4, entropy_coef=1e-4, rho=0.5, updates=1, **SHARED, **NO_GATE, **OURS
)
TDMPC2_NUMBERS = dict(
    lr=None, lr_decay=0.0, terminal="value", command_map=False, command_lr=2e-2, average_decay=0.0, policy_share=1.0
)
TDMPC2_NUMBERS |= dict(updates=1, win_stay=0, **SHARED, **NO_GATE)


def hand_over(agent: Agent, name: str = "sgft", rollouts: int = 1, **changes):
    """Give an agent to a method; returns its update of a batch, after so many rollouts."""
    if name == "sgft":
        method = SGFT(**(SGFT_NUMBERS | changes))
    else:
        method = TDMPC2(**(TDMPC2_NUMBERS | changes)) if name == "tdmpc2" else ZeroShot(**SHARED)
    method.take_over(agent, SENSED)
    return lambda batch: method.update(agent, batch, starts=torch.zeros(rollouts, agent.model.obs_dim))


def make_agent(sizes=None, **changes) -> Agent:
    torch.manual_seed(0)
    return Agent(WorldModel(**(SIZES | (sizes or {}))), **(NUMBERS | changes))


def make_batch(seed=0, batch=32, steps=3, reward=None, terminated=False):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(batch, steps + 1, 6, generator=generator)
    rewards = (
        torch.randn(batch, steps, 1, generator=generator) if reward is None else torch.full((batch, steps, 1), reward)
    )
    ended = torch.zeros(batch, steps, 1, dtype=torch.bool)
    ended[:, -1] = terminated
    following = {"observation": observation[:, 1:], "reward": rewards, "terminated": ended}
    action = torch.rand(batch, steps, 2, generator=generator) * 2 - 1
    return TensorDict(
        {"observation": observation[:, :-1], "action": action, "next": TensorDict(following, [batch, steps])},
        [batch, steps],
    )


def pretrained(**changes) -> Agent:
    agent = make_agent(**changes)
    for i in range(5):
        agent.update(make_batch(i))
    return agent


@torch.no_grad()
def model_error(agent: Agent, batch: TensorDict) -> torch.Tensor:
    """Squared latent error of the dynamics after 1..T steps, [B, T]."""
    data = to_slices(batch, agent.device)
    encoded = agent.model.encode(data.observation)
    zs = losses.imagine(agent.model.dynamics, encoded[0], data.action)
    return losses.consistency_loss(zs[1:], encoded[1:]).transpose(0, 1)


def parts(agent):
    tensors = {p: {k: v.clone() for k, v in getattr(agent.model, p).state_dict().items()} for p in PARTS}
    return tensors


def changed(before, after):
    return {p for p in PARTS if any(not torch.equal(before[p][k], after[p][k]) for k in before[p])}
