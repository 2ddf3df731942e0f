"""What the critic makes of a peg that stands beside its hole, and where episodes that fail on a longer rope end.

    python -m tools.studies.rope_profile results/critic_profile --gap results/critic_profile/rope_long.yaml

`rope.csv`: V of states at rest, the peg 2.5 cm beside the hole, for hands at several heights, over the peg and on the
other side of the hole. `rope_failures.csv`: of the planner's episodes in the gap that fail, before anything is learned,
where peg and hand are at the end. SGFT climbs the frozen V: where that says how the task is done in simulation, and
reality does not allow it, better dynamics show no other way within a few steps.
"""

import argparse
from pathlib import Path

import numpy as np

from envs.tasks.over_table import TOP
from mpc_sgft.api import configure, load_agent, make_env, make_planner
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs.collect import collect, planner_policy
from mpc_sgft.views.deploy_view import values_at_rest
from tools.studies.runner import write

BESIDE = 0.025  # [m] of the peg from the hole's middle
ASIDE = [0.0, 0.05, 0.1, 0.15]  # [m] of the hand from the peg, towards the hole and beyond
ABOVE = [0.03, 0.08, 0.13, 0.18, 0.23, 0.28, 0.33]  # [m] of the hand over the table
PROFILE = ["hand_aside_m", "hand_above_m", "to_peg_m", "value"]
FAILURES = ["peg_beside_m", "peg_above_m", "hand_aside_m", "hand_above_m"]
SEED = 4_000_000  # shared with no collected and no evaluated episode


def profile(model: WorldModel, history: int, half: float, depth: float) -> list[dict[str, float]]:
    """V over places of the hand, at rest and with no commands behind it, for a peg of half the height `half` [m]."""
    rows = [(aside, above) for above in ABOVE for aside in ASIDE]
    hole = np.array([0.5, 0.0, TOP - depth])
    peg = np.array([hole[0] + BESIDE, 0.0, TOP + half])
    hand = np.array([[peg[0] - aside, 0.0, TOP + above] for aside, above in rows])
    value = values_at_rest(np.concatenate([hand, np.tile([*peg, *hole], (len(hand), 1))], 1), model, history)
    reach = np.linalg.norm(hand - peg - [0.0, 0.0, half], axis=1)
    return [
        {"hand_aside_m": aside, "hand_above_m": above, "to_peg_m": round(float(far), 3), "value": round(float(v), 2)}
        for (aside, above), far, v in zip(rows, reach, value, strict=True)
    ]


def failures(observation: np.ndarray, success: np.ndarray) -> list[dict[str, float]]:
    """Where peg and hand end in episodes that fail, from the last observations [N, O] and their successes [N]."""
    rows = []
    for hand, peg, hole in (np.split(row[:9], 3) for row in observation[~success]):
        way = (peg - hole)[:2] / np.linalg.norm((peg - hole)[:2])
        rows.append(
            {
                "peg_beside_m": np.linalg.norm((peg - hole)[:2]),
                "peg_above_m": peg[2] - TOP,
                "hand_aside_m": (peg - hand)[:2] @ way,  # from the peg, towards the hole and beyond
                "hand_above_m": hand[2] - TOP,
            }
        )
    return [{k: round(float(v), 3) for k, v in row.items()} for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--gap", required=True)
    parser.add_argument("--episodes", type=int, default=50)
    args = parser.parse_args()
    cfg = configure("task=rope_peg_in_hole", f"gap={args.gap}")
    model, env, size = load_agent(cfg).model.eval(), make_env(cfg, args.episodes), cfg.task.env
    data = collect(env, planner_policy(model, make_planner(cfg, model.action_dim), SEED), seed=SEED)["next"][:, -1]
    failed = failures(data["observation"].numpy(), data["success"][:, 0].numpy())
    print(f"{len(failed)} of {args.episodes} fail")
    write(args.out / "rope.csv", PROFILE, profile(model, cfg.task.history, size.peg_half_height, size.depth))
    write(args.out / "rope_failures.csv", FAILURES, failed)


if __name__ == "__main__":
    main()
