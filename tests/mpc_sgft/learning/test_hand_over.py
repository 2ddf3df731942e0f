"""What a method trains once it was given an agent, and what stays."""

import pytest
import torch

from mpc_sgft.learning.world_model import PARTS
from tests.mpc_sgft.learning.agents import (
    changed,
    hand_over,
    make_agent,
    make_batch,
    model_error,
    parts,
    pretrained,
)


@pytest.mark.parametrize("residual", [False, True])
def test_sgft_changes_dynamics_and_policy_and_no_frozen_bit(residual):
    agent = pretrained()
    update = hand_over(agent, residual=residual)
    before, frozen = parts(agent), agent.frozen_hash()
    for i in range(3):
        metrics = update(make_batch(10 + i))
    assert changed(before, parts(agent)) == {"dynamics", "policy_head"}
    assert agent.frozen_hash() == frozen
    assert {"consistency_loss", "policy_loss", "objective"} <= set(metrics)
    if residual:
        base = {k: v for k, v in before["dynamics"].items() if k.startswith("base.")}
        now = parts(agent)["dynamics"]
        assert base and all(torch.equal(v, now[k]) for k, v in base.items())


def test_frozen_hash_notices_a_single_changed_entry():
    agent = pretrained()
    hand_over(agent)
    frozen = agent.frozen_hash()
    with torch.no_grad():
        agent.model.normalizer.mean[0] += 1e-6
    assert agent.frozen_hash() != frozen


def test_tdmpc2_trains_everything_but_the_normaliser():
    agent = pretrained()
    update = hand_over(agent, "tdmpc2")
    before, frozen = parts(agent), agent.frozen_hash()
    for i in range(3):
        update(make_batch(10 + i))
    assert changed(before, parts(agent)) == set(PARTS) - {"normalizer"}
    assert agent.frozen_hash() == frozen


def test_zero_shot_trains_nothing_and_says_so():
    agent = pretrained()
    update, before = hand_over(agent, "zero_shot"), parts(agent)
    with pytest.raises(ValueError, match="zero_shot"):
        update(make_batch())
    assert changed(before, parts(agent)) == set() and agent.trainable == ()


def test_transfer_lowers_the_model_error_on_what_it_saw():
    agent = pretrained()
    update = hand_over(agent, lr=3e-3)
    batch = make_batch(77, batch=16)
    before = model_error(agent, batch)
    for _ in range(150):
        update(batch)
    assert before.shape == (16, 3)
    assert model_error(agent, batch).mean() < 0.7 * before.mean()


def test_anchor_keeps_the_dynamics_near_the_pretrained_ones():
    def distance(anchor):
        agent = pretrained()
        update = hand_over(agent, lr=3e-3, anchor=anchor)
        before = parts(agent)["dynamics"]
        for i in range(30):
            update(make_batch(i))
        return sum((v - before[k]).square().sum() for k, v in parts(agent)["dynamics"].items())

    assert distance(1.0) < 0.2 * distance(0.0)


@pytest.mark.parametrize(("decay", "alone"), [(0.0, 1.0), (0.5, 0.25), (1.0, 0.0625)])
def test_the_anchor_fades_with_the_rollouts_as_told(decay: float, alone: float):
    """With sixteen rollouts it weighs what a lighter one weighs with a single rollout."""
    after = []
    for anchor, rollouts in ((0.5, 16), (0.5 * alone, 1)):
        agent = pretrained()
        update = hand_over(agent, lr=3e-3, anchor=anchor, anchor_decay=decay, rollouts=rollouts)
        for i in range(3):
            update(make_batch(i))
        after.append(parts(agent)["dynamics"])
    assert all(torch.equal(x, after[1][name]) for name, x in after[0].items())


def test_snapshot_and_restore_undo_updates_and_go_on_alike():
    agent = pretrained()
    update = hand_over(agent)
    update(make_batch(1))
    snapshot, noise = agent.snapshot(), agent.generator.get_state()
    first = [update(make_batch(i)) for i in (2, 3)]
    after = parts(agent)
    agent.restore(snapshot)
    assert changed(after, parts(agent)) == {"dynamics", "policy_head"}
    agent.generator.set_state(noise)
    assert [update(make_batch(i)) for i in (2, 3)] == first


@pytest.mark.parametrize("method", [None, "sgft", "tdmpc2", "residual"])
def test_resume_gives_the_same_numbers(method):
    def begin(agent):
        if method is None:
            return agent.update
        return hand_over(agent, "sgft", horizon=2, residual=True) if method == "residual" else hand_over(agent, method)

    agent = pretrained()
    update = begin(agent)
    update(make_batch(20))
    state = agent.state_dict()
    expected = [update(make_batch(i)) for i in (21, 22)]
    twin = make_agent()
    again = begin(twin)
    twin.load_state_dict(state)
    assert [again(make_batch(i)) for i in (21, 22)] == expected
    assert changed(parts(agent), parts(twin)) == set()


@pytest.mark.parametrize("transfer", [False, True])
@pytest.mark.parametrize("name", ["observation", "action", "reward"])
def test_a_batch_that_is_not_finite_is_named_and_changes_nothing(transfer, name):
    agent, batch = pretrained(), make_batch()
    update = hand_over(agent) if transfer else agent.update
    place = batch["action"] if name == "action" else batch["next", name]
    place[1, -1, 0] = torch.nan
    before = parts(agent)
    with pytest.raises(FloatingPointError, match=f"^{name} is not finite"):
        update(batch)
    assert changed(before, parts(agent)) == set()
