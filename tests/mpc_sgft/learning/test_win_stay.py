"""Who wins stays: nothing is learned or decided until a rollout fails."""

import copy

import pytest
import torch

from tests.mpc_sgft.learning.transfers import MEMORY, rollout, same, transfer


def test_who_wins_stays_until_a_rollout_fails():
    t = transfer(gate=False, of_method={"win_stay": 2})
    for success, learns in ((True, True), (False, True), (True, True), (True, False), (True, False), (False, True)):
        acting, trained = copy.deepcopy(t.acting), copy.deepcopy(t.agent.model)
        metrics = t.learn(rollout(t.pretrained, seed=len(t.verdicts)), success=success)
        assert (not same(t.acting, acting), not same(t.agent.model, trained)) == (learns, learns), len(t.verdicts)
        assert ("grad_norm" in metrics) is learns and "error_fine_tuned" in metrics and t.stays is not learns
    assert len(t.buffer) == 6 * 12 and len(t.starts) == len(t.verdicts) == 6  # what was not learned from is kept
    t.correct(episode=4, success=False)  # a person says so later
    assert not t.stays


def test_only_what_acts_wins_and_a_broken_streak_begins_anew():
    t = transfer(gate=False, of_method={"win_stay": 2})

    def stays(**how: bool) -> bool:
        t.learn(rollout(t.pretrained, seed=len(t.verdicts)), success=True, **how)
        return t.stays

    assert [stays(warm_up=True) for _ in range(3)] == [False] * 3  # the simulation policy drove
    assert [stays(), stays()] == [False, True]
    t.interrupt()  # a person took over
    again = transfer(gate=False, of_method={"win_stay": 2})
    again.load_state_dict(t.state_dict())
    assert not again.stays and [stays(), stays()] == [False, True]


def test_nothing_is_decided_while_what_wins_stays(monkeypatch):
    """Errors are set here: what was learned predicts better until it wins, and worse then."""
    t, share = transfer(updates=1, margin=0.8, of_method={"win_stay": 2, "gate_memory": 2}), 0.5
    monkeypatch.setattr(
        "mpc_sgft.learning.transfer.open_loop_error",
        lambda model, *_: torch.full((2, 2), 1.0 if model is t.pretrained else share),
    )
    for success in (False, False, True):
        t.learn(rollout(t.pretrained), success=success)
    share = 3.0
    for _ in range(3):
        t.learn(rollout(t.pretrained), success=True)
        assert t.stays and t.verdicts[-1].accepted and same(t.acting, t.averaged.model)
    share = 0.3
    t.learn(rollout(t.pretrained), success=False)
    assert t.verdicts[-1].accepted and same(t.acting, t.averaged.model), "0.9 of the error in two rollouts"


def test_no_map_begins_to_act_while_what_wins_stays(monkeypatch):
    """Errors are set here: with a dead band a tenth of those without, from the first win on."""
    numbers = {"command_map": True, "command_band": True, "win_stay": 2, "gate_memory": 2}
    t, share = transfer(updates=1, margin=0.8, sizes=MEMORY, of_method=numbers), 1.0
    monkeypatch.setattr(
        "mpc_sgft.learning.transfer.open_loop_error",
        lambda model, *_: torch.full((2, 2), share if model.dynamics.band_acts else 1.0),
    )
    for success in (False, False, True):
        t.learn(rollout(t.pretrained), success=success)
    share = 0.1
    for _ in range(3):
        metrics = t.learn(rollout(t.pretrained), success=True)
        assert t.stays and metrics["error_banded"] == pytest.approx(0.1) and not metrics["band_acts"]
    assert t.learn(rollout(t.pretrained), success=False)["band_acts"]
