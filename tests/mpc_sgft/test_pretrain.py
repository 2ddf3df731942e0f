"""How pretraining explores."""

import torch
from omegaconf import OmegaConf

from mpc_sgft.pretrain_loop import explorer
from mpc_sgft.world_model import WorldModel

SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)


class OnlyAModel:
    model = WorldModel(**SIZES)


def test_detours_hold_one_action_in_their_share_of_the_copies():
    detours = {"share": 0.5, "rate": 0.08, "steps": [2, 11], "rest": 0.4}
    cfg = OmegaConf.create({"seed": 3, "num_envs": 200, "detours": detours})
    act, observation = explorer(OnlyAModel(), cfg, 0), torch.zeros(200, 6)
    actions = torch.stack([act(observation, torch.full((200,), t == 0)) for t in range(400)])  # [T, N, A]
    same = (actions[1:] == actions[:-1]).all(-1)  # the policy's own noise never repeats
    assert not same[:, 100:].any()
    rests = (actions == 0).all(-1)
    # a detour of 6 steps on average starts with 0.08 where none is under way: 6 / (6 + 1 / 0.08) of the steps
    assert abs(rests[50:, :100].float().mean() - 0.4 * 6 / (6 + 1 / 0.08)) < 0.02
    moving = same[50:, :100] & ~rests[51:, :100]
    assert abs(moving.float().mean() - 0.6 * 5 / (6 + 1 / 0.08)) < 0.02  # of n equal steps n - 1 repeat
    assert actions.abs().max() <= 1
    again = explorer(OnlyAModel(), cfg, 0)
    assert torch.equal(again(observation, torch.ones(200, dtype=torch.bool)), actions[0])
