"""How pretraining explores, and what it may start from."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from omegaconf import OmegaConf

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build, pretrain
from mpc_sgft.runs.collectors import Inline, Process
from mpc_sgft.runs.explore import Collected, Round, explorer, policy_weights, share
from mpc_sgft.runs.pretrain import start_agent
from mpc_sgft.storage import checkpoint

ROOT = Path(__file__).resolve().parents[3]
SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)


def test_detours_hold_one_action_in_their_share_of_the_copies():
    detours = {"share": 0.5, "rate": 0.08, "steps": [2, 11], "rest": 0.4}
    cfg, model = OmegaConf.create({"detours": detours}), WorldModel(**SIZES)
    act, observation = explorer(model, cfg, 200, seed=3_000_009), torch.zeros(200, 6)
    actions = torch.stack([act(observation, torch.full((200,), t == 0)) for t in range(400)])  # [T, N, A]
    same = (actions[1:] == actions[:-1]).all(-1)  # the policy's own noise never repeats
    assert not same[:, 100:].any()
    rests = (actions == 0).all(-1)
    # a detour of 6 steps on average starts with 0.08 where none is under way: 6 / (6 + 1 / 0.08) of the steps
    assert abs(rests[50:, :100].float().mean() - 0.4 * 6 / (6 + 1 / 0.08)) < 0.02
    moving = same[50:, :100] & ~rests[51:, :100]
    assert abs(moving.float().mean() - 0.6 * 5 / (6 + 1 / 0.08)) < 0.02  # of n equal steps n - 1 repeat
    assert actions.abs().max() <= 1
    again = explorer(model, cfg, 200, seed=3_000_009)
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
    first.model.value_range = 12.5
    meta = checkpoint.describe(cfg, first.model)
    checkpoint.save(tmp_path / "a.safetensors", first.model, meta)
    given = {"checkpoint": str(tmp_path / "a.safetensors"), "seed": 7}
    again = start_agent(config(**given), env)
    assert float(start_agent(config(**given, imagined_steps=4), env).scale.value) == 12.5 != float(again.scale.value)
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


def test_ranges_are_told_in_the_draws_own_units():
    cfg = config(randomize={"draws": {"latency": {"low": 0.0, "high": 0.4}}})
    shapes = torch.tensor([[1.0, 1.0]] * 3 + [[50.0, 50.0]], dtype=torch.float64)
    found = build.drawn_ranges(build.draws_of(cfg), shapes)
    assert found["friction"] == [0.7875, 1.4625]
    low, high = found["latency"]
    assert low + high == pytest.approx(0.4) and high - low == pytest.approx(2 * 1.645 * 0.4 * 0.05, rel=0.02)


def test_the_shares_of_the_workers_make_up_all_environments():
    for count, parts in ((64, 1), (10, 3), (3, 3)):
        shares = [share(count, part, parts) for part in range(parts)]
        assert sum(shares) == count and max(shares) - min(shares) <= 1


@pytest.mark.parametrize("at_random", [True, False])
def test_a_process_collects_what_this_one_would(at_random):
    """A round is a function of its number and of the policy, and survives being written down."""
    cfg = config(num_envs=3)
    agent = build.make_agent(cfg, build.make_env(cfg, 1))
    order = Round(5, None if at_random else policy_weights(agent.model), ((9.0, 2.0),) * 4)
    found = []
    for collector in (Inline(cfg, agent.model.sizes), Process(cfg, agent.model.sizes)):
        collector.start(order)
        found.append(collector.result())
        collector.close()
    found.append(Collected.of(found[1].state_dict()))
    for other in found[1:]:
        assert (found[0].steps == other.steps).all() and other.unstable == 0 and other.shapes == order.shapes
        torch.testing.assert_close(found[0].places, other.places, rtol=0, atol=0, equal_nan=True)
    assert all(min(other.seconds["physics"], other.seconds["act"]) > 0 for other in found)
    assert found[0].steps.shape == (3, build.make_env(cfg, 1).task.episode_steps)


def test_episodes_that_say_nothing_about_the_policy_tell_no_places():
    """Random actions and detours fail for their own reasons; of the others, where their draws lie."""
    cfg = config(num_envs=4)
    agent = build.make_agent(cfg, build.make_env(cfg, 1))
    collector = Inline(cfg, agent.model.sizes)
    told, narrow = [], ((900.0, 100.0),) * 4
    for weights, shapes in ((None, narrow), (policy_weights(agent.model), narrow), (policy_weights(agent.model), None)):
        collector.start(Round(0, weights, shapes))
        told.append(collector.result().places)
    assert told[0].isnan().all() and told[1][:2].isnan().all()
    assert (told[1][2:] - 0.9).abs().max() < 0.05
    assert (told[2][2:] - 0.9).abs().max() > 0.1, "uniform again"


def test_two_workers_number_their_episodes_one_after_the_other():
    cfg = config(num_envs=5)
    agent = build.make_agent(cfg, build.make_env(cfg, 1))
    collector = Process(cfg, agent.model.sizes, workers=2)
    collector.start(Round(0, None))
    steps = collector.result().steps
    collector.close()
    firsts = steps["episode"][:, 0].tolist()
    assert len(steps) == 5 and firsts == sorted(set(firsts)) and firsts[0] == 0
    starts = steps["observation"][:, 0]
    assert torch.unique(starts, dim=0).shape == starts.shape  # no two environments share their random numbers


def test_a_collecting_process_that_dies_is_named():
    cfg = config(num_envs=2)
    collector = Process(cfg, build.make_agent(cfg, build.make_env(cfg, 1)).model.sizes)
    collector.start(Round(0, None))
    collector.result()
    for process in collector._pools[0]._processes.values():
        process.kill()
        process.join()
    with pytest.raises(UserError, match="a collecting process ended.*--resume"):
        collector.start(Round(1, None))
        collector.result()


def test_rows_that_are_no_whole_episodes_are_refused():
    cfg = compose.compose("pretrain", ["task=push", "train=recurrent_dr", "train.replay.slice_len=5"], [])
    with pytest.raises(UserError, match="slice_len=5: train=recurrent_dr learns from rows of whole episodes, 40 steps"):
        pretrain.start_buffer(cfg, torch.device("cpu"), 40)


def test_ctrl_c_ends_no_collecting_process_that_is_starting():
    cfg = config(num_envs=2)
    collector = Process(cfg, build.make_agent(cfg, build.make_env(cfg, 1)).model.sizes)
    collector.start(Round(0, None))
    for process in collector._pools[0]._processes.values():
        for _ in range(5):  # before Python begins in it, and while it imports
            os.kill(process.pid, signal.SIGINT)
            time.sleep(0.2)
    assert len(collector.result().steps) == 2
    collector.close()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set()), "Ctrl-C reaches this process again"


def test_more_workers_than_environments_are_refused():
    with pytest.raises(UserError, match="collector.workers=3: between 1 and num_envs=2"):
        Process(config(num_envs=2), SIZES, workers=3)


@pytest.mark.parametrize(("given", "threads"), [(None, 8), ("", 8), ("0", 8), ("3", 3), ("20", 8), ("4,2", 8)], ids=str)
def test_the_final_evaluation_takes_the_cores_that_it_is_allowed(monkeypatch, given, threads):
    monkeypatch.setattr(pretrain, "cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    assert pretrain.free_threads() == threads


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_learner_that_is_killed_leaves_no_process_behind(tmp_path: Path, how: signal.Signals) -> None:
    line = [sys.executable, "-m", "mpc_sgft.pretrain", "--quiet", "+experiment=debug", "task=pendulum"]
    line += ["transitions=1000000", "log.tensorboard=false", f"run_dir={tmp_path / 'r'}"]
    learner = subprocess.Popen(line, stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        deadline = time.monotonic() + 120
        while not (tmp_path / "r" / "metrics.csv").is_file():
            assert learner.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        family = psutil.Process(learner.pid).children(recursive=True)
        assert family
        learner.send_signal(how)
        learner.wait()
    finally:
        learner.kill()
    _, alive = psutil.wait_procs(family, timeout=20)
    assert not alive
