"""The published task: a few steps of everything that needs nothing from elsewhere. What it comes to is a study."""

import numpy as np
import pytest

from mpc_sgft.methods.iql import IQL
from mpc_sgft.methods.rlpd import RLPD
from mpc_sgft.methods.sac import SAC
from tools.studies import healthy

FEW = {k: v for k, v in healthy.SAC_NUMBERS.items() if k != "entropy_coef"}


@pytest.fixture(autouse=True)
def small(monkeypatch) -> None:
    monkeypatch.setattr(healthy, "RANDOM_STEPS", 50)
    monkeypatch.setattr(healthy, "EPISODES", 2)


def test_actions_span_the_torque_and_the_latent_is_what_is_seen() -> None:
    env, agent = healthy.pendulum(), healthy.new_agent(0)
    env.reset(seed=0)
    env.step(np.ones(1, np.float32))
    assert env.unwrapped.last_u == pytest.approx(2.0)
    seen = env.step(np.zeros(1, np.float32))[0]
    assert seen[:2] @ seen[:2] == pytest.approx(1) and abs(seen[2]) <= 1
    steps = healthy.Steps()
    steps.rows = [(seen, np.ones(1, np.float32), -2.0, seen)]
    batch = steps.batch(4, np.random.default_rng(0))
    assert batch.shape == (4, 1) and (batch["next", "reward"] == -2).all()
    assert np.array_equal(agent.model.encode(batch["observation"])[0, 0, :3].numpy(), seen)


def test_every_method_runs_and_is_measured() -> None:
    act, updates = healthy.online(SAC(**healthy.SAC_NUMBERS), 0, 60)
    assert updates == 10
    again, _ = healthy.online(SAC(**healthy.SAC_NUMBERS), 0, 60)
    assert healthy.evaluated(act) == healthy.evaluated(again)
    data, rng = healthy.Steps(), np.random.default_rng(0)
    data.rows = [
        (*rng.uniform(-1, 1, (1, 3)).astype("f"), rng.uniform(-1, 1, 1).astype("f"), 0.0, np.zeros(3, "f"))
    ] * 9
    healthy.online(RLPD(simulated_episodes=0, **healthy.SAC_NUMBERS), 0, 55, data)
    method = IQL(**FEW, expectile=0.7, temperature=1.0, simulated_episodes=0)
    assert np.isfinite(healthy.evaluated(healthy.offline(method, 0, data, 5)[0])["return"])
