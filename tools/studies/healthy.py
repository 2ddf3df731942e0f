"""Methods without a planner where others have published: do they learn there what they should?

    python -m tools.studies.healthy results/healthy/healthy.csv --seeds 0 1 2

Gymnasium's Pendulum-v1, learned from nothing, beside a maintained implementation at the same steps, updates, batches
and learning rate:

    sac     on its own steps, beside stable-baselines3
    iql     on the steps that stable-baselines3's SAC took, offline, beside d3rlpy
    rlpd    on a quarter as many steps of its own, with those as prior data, beside `sac` on as many

The methods see what Pendulum shows them in place of a latent. It needs `pip install 'mpc_sgft[sb3]'`, and d3rlpy, which
asks for an older Gymnasium than it needs: `pip install --no-deps d3rlpy; pip install h5py gym click structlog colorama
dataclasses-json scikit-learn`. Without d3rlpy its rows are missing. Minutes a seed on one core.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F
from hydra.utils import instantiate
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from mpc_sgft.command.compose import compose
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.method import AbstractMethod
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.methods.iql import IQL
from mpc_sgft.methods.rlpd import RLPD
from mpc_sgft.methods.sac import SAC
from planners.malloc import keep_freed_memory
from tools.studies.runner import measured

COLUMNS = ["method", "implementation", "seed", "steps", "updates", "episodes", "return", "sd", "seconds"]
RANDOM_STEPS = 500  # before anything is learned
BATCH, DISCOUNT, LR = 256, 0.99, 1e-3  # rl-baselines3-zoo's for Pendulum
EPISODES = 50  # of an evaluation, the same for all
SAC_NUMBERS = {"lr": LR, "policy_lr": LR, "entropy_coef": 0.1, "updates": 1, "slice_len": 1, "action_noise": 0.0}
Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Shown(WorldModel):
    """A world model whose latent is what is observed, filled up with zeros."""

    def encode(self, observation: Tensor) -> Tensor:
        return F.pad(observation, (0, self.latent_dim - self.obs_dim))


class Steps:
    """Transitions that were taken: [n] rows of observation, action in [-1, 1], reward, what followed."""

    def __init__(self) -> None:
        self.rows: list[tuple[NDArray, NDArray, float, NDArray]] = []

    def batch(self, count: int, rng: np.random.Generator) -> TensorDict:
        """Drawn with replacement, [B, 1]; a pendulum never terminates."""
        drawn = [self.rows[i] for i in rng.integers(len(self.rows), size=count)]
        seen, action, reward, following = (
            torch.tensor(np.array(x), dtype=torch.float32)[:, None] for x in zip(*drawn, strict=True)
        )
        ended = torch.zeros(count, 1, 1, dtype=torch.bool)
        after = TensorDict({"observation": following, "reward": reward[..., None], "terminated": ended}, [count, 1])
        return TensorDict({"observation": seen, "action": action, "next": after}, [count, 1])


def pendulum() -> gymnasium.Env:
    """With actions in [-1, 1] and speeds as large as its angles."""
    env = gymnasium.wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), np.float32(-1), np.float32(1))
    scale = np.array([1, 1, 0.125], np.float32)
    return gymnasium.wrappers.TransformObservation(
        env, lambda seen: (seen * scale).astype(np.float32), env.observation_space
    )


def new_agent(seed: int) -> Agent:
    """Nothing learned yet; of the size of SAC's networks."""
    torch.manual_seed(seed)
    sizes = {"obs_dim": 3, "action_dim": 1, "decode_dim": 3, "latent_dim": 8, "mlp_dim": 256, "enc_dim": 8, "num_q": 2}
    train = compose("pretrain", [], []).train.agent
    return instantiate(train, model=Shown(**sizes, dropout=0.0), seed=seed, discount=DISCOUNT, target_rate=0.005)


def take_over(method: AbstractMethod, agent: Agent) -> None:
    method.take_over(agent, Sensed(("cos", "sin", "speed"), torch.zeros(1, 3)))


def online(method: AbstractMethod, seed: int, steps: int, prior: Steps | None = None) -> tuple[Act, int]:
    """An update a step on what was seen so far, half of each batch from `prior` if there is one."""
    agent, env, rng = new_agent(seed), pendulum(), np.random.default_rng(seed)
    take_over(method, agent)
    seen, _ = env.reset(seed=seed)
    found, noise = Steps(), torch.Generator().manual_seed(seed)
    for step in range(steps):
        if step < RANDOM_STEPS:
            action = rng.uniform(-1, 1, 1).astype(np.float32)
        else:
            with torch.no_grad():
                z = agent.model.encode(torch.from_numpy(seen)[None])
                action = agent.model.policy(z, torch.randn(1, 1, generator=noise))[0][0].numpy()
        following, reward, _, over, _ = env.step(action)
        found.rows.append((seen, action, float(reward), following))
        seen = env.reset()[0] if over else following
        if step >= RANDOM_STEPS:
            parts = [found.batch(BATCH if prior is None else BATCH // 2, rng)]
            parts += [prior.batch(BATCH // 2, rng)] if prior is not None else []
            method.update(agent, torch.cat(parts), starts=torch.zeros(1, 3))
    return acting(agent), steps - RANDOM_STEPS


def offline(method: AbstractMethod, seed: int, data: Steps, updates: int) -> tuple[Act, int]:
    agent, rng = new_agent(seed), np.random.default_rng(seed)
    take_over(method, agent)
    for _ in range(updates):
        method.update(agent, data.batch(BATCH, rng), starts=torch.zeros(1, 3))
    return acting(agent), updates


def acting(agent: Agent) -> Act:
    """The mean action."""
    model = agent.model.eval()

    @torch.no_grad()
    def act(seen: NDArray[np.float32]) -> NDArray[np.float32]:
        return model.policy_prior(model.encode(torch.from_numpy(seen)), None).numpy()

    return act


def evaluated(act: Act) -> dict[str, float]:
    """Return of episodes whose starts nobody learned from."""
    returns, env = [], pendulum()
    for episode in range(EPISODES):
        seen, over, total = env.reset(seed=10_000 + episode)[0], False, 0.0
        while not over:
            seen, reward, _, over, _ = env.step(act(seen[None])[0])
            total += float(reward)
        returns.append(total)
    return {"episodes": EPISODES, "return": round(float(np.mean(returns)), 1), "sd": round(float(np.std(returns)), 1)}


class Theirs:
    """stable-baselines3's SAC, trained once a seed: a row of its own, and data for the others."""

    def __init__(self, seed: int, steps: int) -> None:
        from stable_baselines3 import SAC as TheirSAC

        began = time.monotonic()
        numbers = {"learning_rate": LR, "gamma": DISCOUNT, "batch_size": BATCH, "learning_starts": RANDOM_STEPS}
        model = TheirSAC("MlpPolicy", pendulum(), seed=seed, device="cpu", **numbers).learn(steps)
        self.seconds = time.monotonic() - began
        self.act: Act = lambda seen: model.predict(seen, deterministic=True)[0]
        self.data, kept = Steps(), model.replay_buffer
        columns = (kept.observations, kept.actions, kept.rewards, kept.next_observations)
        self.data.rows = [
            (seen, action, float(reward), following)
            for seen, action, reward, following in zip(*(x[:steps, 0] for x in columns), strict=True)
        ]


def d3rlpy_iql(seed: int, data: Steps, updates: int, iql: dict[str, float]) -> tuple[Act, int]:
    """The maintained one."""
    import d3rlpy

    d3rlpy.seed(seed)
    seen, action, reward, _ = (np.array(x, np.float32) for x in zip(*data.rows, strict=True))
    ends = np.arange(1, len(seen) + 1) % 200 == 0  # an episode lasts 200 steps
    whole = d3rlpy.dataset.MDPDataset(seen, action, reward[:, None], terminals=np.zeros(len(seen)), timeouts=ends)
    config = d3rlpy.algos.IQLConfig(
        actor_learning_rate=LR,
        critic_learning_rate=LR,
        batch_size=BATCH,
        gamma=DISCOUNT,
        expectile=iql["expectile"],
        weight_temp=1 / iql["temperature"],
    )
    learner = config.create(device=False)
    learner.fit(whole, n_steps=updates, n_steps_per_epoch=updates, show_progress=False, save_interval=10**9,
                logger_adapter=d3rlpy.logging.NoopAdapterFactory())  # fmt: skip
    return learner.predict, updates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=10_000, help="of SAC; of RLPD a quarter")
    parser.add_argument("--expectile", type=float, default=0.7, help="of IQL")
    parser.add_argument("--temperature", type=float, default=1.0, help="of IQL, reward units")
    args = parser.parse_args()
    try:
        import stable_baselines3  # noqa: F401
    except ImportError:
        parser.error("stable-baselines3 is not installed: pip install 'mpc_sgft[sb3]'")
    torch.set_num_threads(1)
    keep_freed_memory()
    iql = {"expectile": args.expectile, "temperature": args.temperature}
    known: dict[int, Theirs] = {}

    def of(seed: int) -> Theirs:
        if seed not in known:
            known[seed] = Theirs(seed, args.steps)
        return known[seed]

    def work(method: str, implementation: str, seed: int, steps: int) -> dict:
        data = of(seed).data if method != "sac" else Steps()  # before the clock starts
        began = time.monotonic()
        match method, implementation:
            case "sac", "stable-baselines3":
                act, updates, began = of(seed).act, steps - RANDOM_STEPS, time.monotonic() - of(seed).seconds
            case "sac", _:
                act, updates = online(SAC(**SAC_NUMBERS), seed, steps)
            case "rlpd", _:
                act, updates = online(RLPD(simulated_episodes=0, **SAC_NUMBERS), seed, steps, data)
            case "iql", "ours":
                shared = {k: v for k, v in SAC_NUMBERS.items() if k != "entropy_coef"}
                act, updates = offline(IQL(**shared, **iql, simulated_episodes=0), seed, data, steps)
            case _:
                act, updates = d3rlpy_iql(seed, data, steps, iql)
        cost = {"steps": steps, "updates": updates, "seconds": round(time.monotonic() - began, 1)}
        return {"method": method, "implementation": implementation, "seed": seed} | cost | evaluated(act)

    ways = [("sac", "stable-baselines3"), ("sac", "ours"), ("iql", "d3rlpy"), ("iql", "ours")]
    ways += [("sac", "ours, a quarter of the steps"), ("rlpd", "ours, a quarter of the steps")]
    try:
        import d3rlpy  # noqa: F401
    except ImportError:
        ways.remove(("iql", "d3rlpy"))
    few = args.steps // 4
    keys = [
        {"method": m, "implementation": i, "seed": seed, "steps": few if "quarter" in i else args.steps}
        for seed in args.seeds
        for m, i in ways
    ]
    measured(args.csv, COLUMNS, keys, work)


if __name__ == "__main__":
    main()
