"""Success of a checkpoint, or of a simple policy, on any task and gap."""

import json
from typing import cast

from omegaconf import DictConfig
from tensordict import TensorDict

from mpc_sgft.command.errors import UserError, from_config
from mpc_sgft.runs import build
from mpc_sgft.runs.collect import Act, collect, planner_policy, random_policy, score, scripted_policy, shown
from mpc_sgft.runs.pretrain import EVAL_SEED
from mpc_sgft.storage import run_folder
from mpc_sgft.storage.metrics import progress

CHUNK = 100  # episodes side by side
APART = 1000  # seeds of the rounds of one seed: those of the next one are others


def evaluate(cfg: DictConfig) -> int:
    """Run the episodes, print and save the result as JSON; returns the exit code."""
    if cfg.backend.name != "sim":
        raise UserError("evaluate runs in simulation. On the robot: deploy --backend franka method=zero_shot.")
    env = build.make_env(cfg, min(cfg.episodes, CHUNK), randomised=True)
    if cfg.episodes % env.batch_size[0]:
        raise UserError(f"episodes={cfg.episodes}: more than {CHUNK} must be a multiple of {CHUNK}.")
    act, film = _policy(cfg, env), None
    if cfg.video:  # what is missing shows before hours of episodes
        from mpc_sgft.views.video import Film

        film = Film(build.make_env(cfg, 1))
    folder = run_folder.start(cfg)
    run_folder.keep_told(cfg, folder)
    build.prepare_process(cfg)
    rounds, first = cfg.episodes // env.batch_size[0], EVAL_SEED + APART * cfg.seed
    with progress(rounds * env.task.episode_steps, desc="evaluate", disable=cfg.quiet) as bar:
        parts = [collect(env, shown(act, bar), seed=first + i) for i in range(rounds)]
    result = score(cast(TensorDict, TensorDict.cat(parts)))
    summary = {
        "task": cfg.chosen.task,
        "gap": cfg.chosen.gap,
        "randomize": cfg.chosen.randomize,
        "policy": cfg.policy,
        "planner": cfg.chosen.planner if cfg.policy == "planner" else None,
        "seed": cfg.seed,
        "episodes": result.episodes,
        "success": result.success,
        "success_interval": [result.success_low, result.success_high],
        "return": result.episode_return,
        "unstable_episodes": env.backend.counters["unstable"],
    }
    if film is not None:
        summary["video"] = str(film.write(folder / "episode.mp4", act, first))
    run_folder.write_summary(folder, summary)
    print(json.dumps(summary))
    return 0


def _policy(cfg: DictConfig, env) -> Act:
    if cfg.policy in ("zero", "random"):
        return random_policy(env, cfg.seed, scale=float(cfg.policy == "random"))
    if cfg.policy == "scripted":
        return scripted_policy(env)
    agent, _ = build.load_agent(cfg)
    build.check_fits(agent.model, env)
    with from_config("planner"):
        return planner_policy(agent.model, build.make_planner(cfg, env.action_dim), cfg.seed)
