"""A method is one file and one yaml; and each computes what it did when `Agent` held them all."""

import copy
import json
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from tensordict import TensorDict

from mpc_sgft.command import choices, compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.method import AbstractMethod
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.transfer import Transfer
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs.fine_tuning import make_transfer

SIZES = {"obs_dim": 6, "action_dim": 1, "decode_dim": 2, "memory_dim": 2, "latent_dim": 16, "mlp_dim": 32}
SIZES |= {"enc_dim": 32, "num_q": 2}
METHODS = choices.groups()["method"]
# Written by the version in which Agent held every method (commit 6d50529), with the numbers below; those of sgft with a
# command map by the version in which it learns with the simulator, with an observation map by the one that added it.
AS_BEFORE = json.loads((Path(__file__).parent / "as_before.json").read_text())


def rollout(seed: int, steps: int = 12) -> TensorDict:
    """An episode [T] of random observations."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(steps + 1, 6, generator=generator)
    action = 2 * torch.rand(steps, 1, generator=generator) - 1
    flags = {k: torch.zeros(steps, 1, dtype=torch.bool) for k in ("terminated", "truncated", "done", "invalid")}
    following = TensorDict({"observation": observation[1:], "reward": torch.zeros(steps, 1), **flags}, [steps])
    number = {"episode": torch.full((steps,), seed), "step": torch.arange(steps)}
    return TensorDict({"observation": observation[:-1], "action": action, **number, "next": following}, [steps])


def make(*overrides: str, device: str = "cpu") -> Transfer:
    given = ["train.replay.batch_size=16", *overrides]
    cfg = compose.compose("deploy", [compose.normalise(text) for text in given], given)
    torch.manual_seed(0)
    agent: Agent = instantiate(cfg.train.agent, model=WorldModel(**SIZES), seed=0, device=device, discount=0.9)
    return make_transfer(cfg, agent, Sensed(("tip_x", "tip_y"), torch.zeros(2, 2)), 12, simulated)


def simulated(episodes: int) -> TensorDict:
    """Not every entry of a simulated step is there in a real one."""
    steps = torch.stack([rollout(1000 + seed) for seed in range(min(episodes, 4))])
    return steps.set("action_sent", steps["action"])


def test_every_file_is_a_method_and_every_method_has_its_numbers():
    import mpc_sgft.methods

    files = {p.stem for p in Path(mpc_sgft.methods.__file__).parent.glob("*.py")} - {"__init__"}
    assert files == set(METHODS)


@pytest.mark.parametrize("name", METHODS)
def test_a_method_changes_what_it_says_and_nothing_else(name):
    t = make(f"method={name}")
    assert isinstance(t.method, AbstractMethod)
    frozen, before = t.agent.frozen_hash(), {k: v.clone() for k, v in t.agent.model.state_dict().items()}
    for seed in range(2):
        t.learn(rollout(seed))
    assert t.agent.frozen_hash() == frozen
    moved = {k for k, v in t.agent.model.state_dict().items() if not torch.equal(v, before[k])}
    for part in t.agent.trainable:
        assert t.method.updates == 0 or any(k.startswith(part + ".") for k in moved), part
    assert all(any(k.startswith(part + ".") for part in t.agent.trainable) for k in moved)
    saved = copy.deepcopy(t.state_dict())
    expected, again = t.learn(rollout(3)), make(f"method={name}")
    again.load_state_dict(saved)
    assert again.learn(rollout(3)) == expected


@pytest.mark.gpu
@pytest.mark.parametrize("name", METHODS)
def test_a_method_learns_on_a_gpu(name):
    t = make(f"method={name}", device="cuda")
    for seed in range(2):
        t.learn(rollout(seed))
    z = t.agent.model.encode(torch.zeros(3, 6, device="cuda"))
    assert z.is_cuda and z.isfinite().all()
    assert {x.device.type for x in t.agent.model.state_dict().values()} == {"cuda"}


@pytest.mark.parametrize("words", AS_BEFORE)
def test_the_numbers_are_those_of_before(words):
    """Another processor may round otherwise; the run on which these were written agrees to the last bit."""
    name, *settings = words.split()
    t = make(f"method={name}", "method.updates=10", *(s.replace("transfer.", "method.") for s in settings))
    for seed, metrics in enumerate(AS_BEFORE[words]["metrics"]):
        assert t.learn(rollout(seed)) == pytest.approx(metrics, rel=1e-3, abs=1e-5)
    now, then = t.agent.model.state_dict(), t.pretrained.state_dict()
    moved = {k: float((now[k] - then[k]).norm()) for k in sorted(now) if now[k].is_floating_point()}
    assert {k: v for k, v in moved.items() if v} == pytest.approx(AS_BEFORE[words]["moved"], rel=1e-3)
    assert [v.accepted for v in t.verdicts] == AS_BEFORE[words]["acting"]


def test_a_method_brings_its_planner_and_the_command_line_wins() -> None:
    def elites(*words: str) -> int:
        return compose.compose("deploy", [compose.normalise(w) for w in words], list(words)).planner.num_elites

    assert elites("method=sgft_paper") == 16 < elites()
    assert elites("method=sgft_paper", "planner=cem") == 64
    assert elites("method=sgft_paper", "planner.num_elites=32") == 32


def test_plans_end_in_what_the_method_says_whatever_the_checkpoint_was_last_used_with() -> None:
    t = make("method=tdmpc2", "method.terminal=q")
    assert {x.sizes["terminal"] for x in (t.agent.model, t.acting, t.pretrained)} == {"q"}
    sensed = Sensed(("tip_x", "tip_y"), torch.zeros(2, 2))
    sizes = {"capacity": 100, "batch_size": 4, "seed": 0}
    again = Transfer(t.agent, make("method=sgft").method, sensed, simulated=simulated, **sizes)
    assert again.acting.sizes["terminal"] == "value"


@pytest.mark.parametrize("name", METHODS)
def test_half_of_each_batch_is_simulated_where_a_method_says_so(name: str) -> None:
    t = make(f"method={name}")
    t.buffer.extend(rollout(0))
    real = t.batch()["episode"] < 1000
    wanted = 8 if name in ("rlpd", "iql", "h2o", "asap") else 16
    assert len(real) == 16 and real[:wanted].all() and not real[wanted:].any()


@pytest.mark.parametrize("bad", ["expectile=0.5", "expectile=1", "temperature=0"])
def test_numbers_of_implicit_q_learning_out_of_range_are_refused_with_their_name(bad: str) -> None:
    with pytest.raises(UserError, match=bad.split("=")[0]):
        make("method=iql", f"method.{bad}")


@pytest.mark.parametrize("bad", ["simulated_episodes=0", "penalty=-1"])
def test_numbers_of_hybrid_learning_out_of_range_are_refused_with_their_name(bad: str) -> None:
    with pytest.raises(UserError, match=bad):
        make("method=h2o", f"method.{bad}")
    with pytest.raises(UserError, match="simulated_episodes=-1 must be 0 or more"):
        make("method=rlpd", "method.simulated_episodes=-1")


@pytest.mark.parametrize("bad", ["simulated_episodes=0", "steps=0", "shrink=-1", "rho=2"])
def test_numbers_of_delta_actions_out_of_range_are_refused_with_their_name(bad: str) -> None:
    with pytest.raises(UserError, match=bad):
        make("method=asap", f"method.{bad}")


@pytest.mark.parametrize("bad", ["slice_len=0", "branches=-1", "rho=0"])
def test_numbers_of_dyna_sgft_out_of_range_are_refused_with_their_name(bad: str) -> None:
    with pytest.raises(UserError, match=bad):
        make("method=sgft_sac", f"method.{bad}")


def test_sgft_as_published_learns_the_reward() -> None:
    """From rollouts that it may learn by heart; `sgft` leaves the reward as it was."""
    t = make("method=sgft_paper", "method.lr=3e-3")
    steps = rollout(0)
    steps["next", "reward"] = steps["next", "observation"][:, :1].clone()
    t.buffer.extend(steps)
    curve = [t.method.update(t.agent, t.buffer.sample(), starts=steps["observation"][:1]) for _ in range(150)]
    assert curve[-1]["reward_loss"] < 0.4 * curve[0]["reward_loss"]


def test_encoder_and_reward_may_be_frozen_in_sgft_as_published() -> None:
    everything = set(make("method=sgft_paper").agent.trainable)
    assert everything == {"encoder", "dynamics", "reward_head", "policy_head"}
    assert set(make("method=sgft_paper", "method.encoder=false").agent.trainable) == everything - {"encoder"}
    assert set(make("method=sgft_paper", "method.reward=false").agent.trainable) == everything - {"reward_head"}
