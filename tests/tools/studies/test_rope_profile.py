"""Why a longer rope is hard: the critic sends the hand across the hole."""

import numpy as np

from mpc_sgft.api import configure, load_agent
from tools.studies.rope_profile import failures, profile


def test_the_critic_would_drag_a_peg_that_stands_beside_the_hole():
    cfg = configure("task=rope_peg_in_hole")
    rows = profile(load_agent(cfg).model.eval(), cfg.task.history, half=0.02, depth=0.03)
    value = {(row["hand_aside_m"], row["hand_above_m"]): row["value"] for row in rows}
    assert value[0.15, 0.03] > value[0.0, 0.03] + 2 and value[0.15, 0.03] > value[0.0, 0.33] + 2
    at = {(row["hand_aside_m"], row["hand_above_m"]): row["to_peg_m"] for row in rows}
    assert at[0.0, 0.33] == 0.29 and at[0.05, 0.03] == 0.051


def test_where_an_episode_failed_is_told_from_the_hole():
    hole, peg, hand = np.array([0.5, 0.0, 0.07]), np.array([0.5, 0.03, 0.12]), np.array([0.6, -0.07, 0.13])
    (row,) = failures(np.stack([np.concatenate([hand, peg, hole, [9.0]])] * 2), np.array([True, False]))
    assert row == {"peg_beside_m": 0.03, "peg_above_m": 0.02, "hand_aside_m": 0.1, "hand_above_m": 0.03}
