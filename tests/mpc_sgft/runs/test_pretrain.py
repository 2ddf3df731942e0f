"""How pretraining explores, and what it may start from."""

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build
from mpc_sgft.runs.pretrain import explorer, start_agent
from mpc_sgft.storage import checkpoint

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


def test_only_what_pretraining_learns_from_strays_past_the_line() -> None:
    cfg = compose.compose("pretrain", ["task=push"], [])
    learned, measured = (build.make_env(cfg, 400, learning=learning).backend for learning in (True, False))
    for backend in (learned, measured):
        backend.seed(5)
    starts = learned.reset(np.arange(400))[:, 2]
    beyond = cfg.task.in_training.stray_share * (0.7 - 0.575) / 0.7  # of the episodes start past the band
    assert abs((starts > 0.575).mean() - beyond) < 3 * (beyond / 400) ** 0.5 and starts.max() < 0.7
    assert measured.reset(np.arange(400))[:, 2].max() <= 0.3


def config(**changed):
    cfg = compose.compose("pretrain", ["task=push", "+experiment=debug"], [])
    OmegaConf.set_struct(cfg, False)
    return OmegaConf.merge(cfg, changed)


def test_pretraining_goes_on_from_a_checkpoint(tmp_path):
    cfg = config(device="cpu")
    env = build.make_env(cfg, 1)
    first = build.make_agent(cfg, env)
    meta = checkpoint.describe(cfg, first.model)
    checkpoint.save(tmp_path / "a.safetensors", first.model, meta)
    again = start_agent(config(checkpoint=str(tmp_path / "a.safetensors"), seed=7), env)
    for name, x in first.model.state_dict().items():
        assert torch.equal(x, again.model.state_dict()[name]), name
    fresh = start_agent(config(seed=7), env).model.state_dict()
    assert any(not torch.equal(x, fresh[name]) for name, x in first.model.state_dict().items())


def test_a_deployment_s_checkpoint_is_no_start_for_pretraining(tmp_path):
    cfg = config()
    env = build.make_env(cfg, 1)
    agent = build.make_agent(cfg, env)
    agent.model.add_command_map()
    checkpoint.save(tmp_path / "a.safetensors", agent.model, checkpoint.describe(cfg, agent.model))
    with pytest.raises(UserError, match="comes from a deployment .it has a command_map"):
        start_agent(config(checkpoint=str(tmp_path / "a.safetensors")), env)


def test_found_effects_and_draws_combine():
    found = {"actuator_delay": {"delay": 0.3}, "payload": {"mass": 0.5, "at": ["puck"]}}
    env = build.make_env(config(gap={"effects": found}), 8, randomised=True)
    env.set_seed(0)
    env.reset()
    latency = env.backend.batch.expand("actuator_delay")[:, 0]
    assert (latency >= 0.3).all() and (latency <= 0.45).all() and len(set(latency)) == 8
    assert env.backend.model.body("payload_puck").mass[0] == 0.5
