"""The shipped critic knows what it costs to push the puck past the line."""

import torch

from tools.studies.critic_profile import lasting_return, row


def test_a_puck_past_the_line_is_worth_less_than_nothing_as_the_planner_finds_too():
    _, _, _, on_line, there = row("shipped", None, 0.55, episodes=4)
    _, _, _, past_line, beyond = row("shipped", None, 0.62, episodes=4)
    assert there > 10 and on_line > 0  # 20 steps' worth of one a step
    assert beyond < 0 and past_line < 0


def test_the_last_reward_counts_for_ever():
    assert lasting_return(torch.tensor([[1.0, 2.0]]), 0.5).tolist() == [1 + 0.5 * 2 / (1 - 0.5)]
