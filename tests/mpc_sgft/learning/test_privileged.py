"""Policies taught by critics that know what the simulator drew, with a memory and without."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from mpc_sgft.learning.privileged import PrivilegedActorCritic
from mpc_sgft.learning.row_buffer import RowBuffer
from mpc_sgft.learning.world_model import WorldModel
from planners.policy import PolicyPlanner

SIZES = dict(obs_dim=6, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)
NUMBERS = dict(lr=3e-3, policy_lr=3e-3, policy_delay=1, grad_clip=20.0, target_rate=0.05, average_decay=0.5)
NUMBERS |= dict(entropy_coef=0.01, entropy_lr=0.0, discount=0.0)
STEPS = 6


def learner(memory_dim: int, **changed) -> PrivilegedActorCritic:
    torch.manual_seed(0)
    return PrivilegedActorCritic(WorldModel(**SIZES), draws=("cue",), memory_dim=memory_dim, **NUMBERS | changed)


def rows(seed: int, count: int = 32) -> TensorDict:
    """Random actions; the first entry is worth most at the cue, a place that is seen in the first step alone."""
    draw = torch.Generator().manual_seed(seed)
    cue = torch.rand(count, 1, 1, generator=draw).expand(count, STEPS + 1, 1)
    step = torch.arange(STEPS + 1).expand(count, -1)
    seen = torch.randn(count, STEPS + 1, 6, generator=draw)
    seen[..., 2] = 0.5 * step  # known to the critics, too
    seen[..., 3:4] = torch.where(step[..., None] == 0, 4 * cue - 2, 0.0)
    known = torch.cat([seen[..., :3], cue], -1)
    action = 2 * torch.rand(count, STEPS, 2, generator=draw) - 1
    reward = -5 * (action[..., :1] - (2 * cue[:, :-1] - 1)).square()
    no = torch.zeros(count, STEPS, 1, dtype=torch.bool)
    after = {"observation": seen[:, 1:], "privileged": known[:, 1:], "reward": reward, "terminated": no, "invalid": no}
    now = {"observation": seen[:, :-1], "privileged": known[:, :-1], "action": action, "step": step[:, :-1]}
    return TensorDict({**now, "next": TensorDict(after, [count, STEPS])}, [count, STEPS]).clone()


def miss(found: PrivilegedActorCritic, data: TensorDict) -> Tensor:
    """Mean distance of the first action to the cue's, by step [T]."""
    with torch.no_grad():
        z, begins = found.model.encode(data["observation"]), data["step"] == 0
        mean = torch.tanh(found.model.moments_along(z, begins)[0][..., 0])
    return (mean - (2 * data["privileged"][..., 3] - 1)).abs().mean(0)


def test_who_remembers_acts_on_what_was_seen_once_and_who_does_not_cannot() -> None:
    remembers, forgets = learner(16), learner(0)
    for i in range(250):
        for one in (remembers, forgets):
            one.update(rows(i))
    held = rows(10_000, 400)
    kept, lost = miss(remembers, held), miss(forgets, held)
    assert kept.max() < 0.3, kept
    assert lost[0] < 0.3 and lost[1:].min() > 0.4, lost  # best without knowing: 0, a mean distance of 0.5


def test_a_row_gives_what_its_steps_give_one_by_one() -> None:
    model = learner(8).model
    z, begins = torch.randn(3, 7, 16), torch.zeros(3, 7, dtype=torch.bool)
    begins[:, 0], begins[1, 4] = True, True
    with torch.no_grad():
        along = torch.tanh(model.moments_along(z, begins)[0])
        memory, found = torch.randn(3, 8), []
        for t in range(7):
            action, memory = model.recurrent_action(z[:, t], memory, begins[:, t], None)
            found.append(action)
    torch.testing.assert_close(torch.stack(found, 1), along)


def test_the_planner_follows_the_policy_with_the_memory() -> None:
    model = learner(8).model.eval()
    planner, generator, plan = PolicyPlanner(action_dim=2, horizon=3, discount=0.9), torch.Generator(), None
    z, begins = torch.randn(2, 5, 16), torch.zeros(2, 5, dtype=torch.bool)
    begins[:, 0], begins[1, 3] = True, True
    found = []
    for t in range(5):
        plan = planner.plan(model, z[:, t], plan, begins[:, t] if t else None, generator)
        found.append(plan.action)
        ahead = torch.stack([z[:, t], model.next(z[:, t], plan.action)], 1)
        memory_before = plan.memory
    with torch.no_grad():
        torch.testing.assert_close(torch.stack(found, 1), torch.tanh(model.moments_along(z, begins)[0]))
        second, _ = model.recurrent_action(ahead[:, 1], memory_before, torch.zeros(2, dtype=torch.bool), None)
    torch.testing.assert_close(plan.mean[:, 1], second)  # imagined on from what it remembers


def values(found: PrivilegedActorCritic, data: TensorDict) -> Tensor:
    """Q of the recorded actions, mean over both critics, [B, T]."""
    with torch.no_grad():
        z, known = found.model.encode(data["observation"]), found._known(data["privileged"])
        return found._worth(found.critics, z, known, data["action"]).mean(0)


def test_what_ends_is_worth_its_reward_and_what_is_invalid_teaches_nothing() -> None:
    """Reward 1 a step and a discount of 0.5: 2 - 0.5^k, k steps before the end."""
    found = learner(0, discount=0.5, entropy_coef=1e-6)
    data = rows(0)
    data["next", "reward"][:] = 1.0
    data["next", "terminated"][:, -1] = True
    data["next", "invalid"][:, 2] = True
    data["next", "reward"][:, 2] = 1000.0
    for _ in range(250):
        found.update(data)
    q = values(found, data).mean(0)
    steps = [0, 1, 3, 4, 5]
    torch.testing.assert_close(q[steps], 2 - 0.5 ** torch.tensor([5.0, 4, 2, 1, 0]), atol=0.15, rtol=0)
    assert q[2] < 3


def test_only_the_policy_of_the_model_changes() -> None:
    for memory_dim, part in ((0, "policy_head"), (8, "recurrent_policy")):
        found = learner(memory_dim)
        before = {name: x.clone() for name, x in found.model.state_dict().items()}
        for i in range(3):
            found.update(rows(i))
        after = found.model.state_dict()
        moved = {name.split(".")[0] for name, x in before.items() if not torch.equal(x, after[name])}
        assert moved == {part}


def test_it_goes_on_with_the_same_numbers() -> None:
    first, again = learner(8, entropy_lr=1e-3), learner(8, entropy_lr=1e-3)
    for i in range(3):
        first.update(rows(i))
    again.load_state_dict(first.state_dict())
    for i in range(3, 6):
        assert first.update(rows(i)) == again.update(rows(i))
    for name, x in first.averaged.state_dict().items():
        assert torch.equal(x, again.averaged.state_dict()[name]), name


def test_numbers_that_are_not_finite_are_named_and_change_nothing() -> None:
    found, data = learner(0), rows(0)
    data["next", "reward"][3, 2] = torch.nan
    before = {name: x.clone() for name, x in found.critics.state_dict().items()}
    with pytest.raises(FloatingPointError, match="reward"):
        found.update(data)
    assert all(torch.equal(x, found.critics.state_dict()[name]) for name, x in before.items())


def test_a_memory_is_begun_once() -> None:
    with pytest.raises(ValueError, match="has a policy with a memory; begin with"):
        learner(8).model.begin_policy(8)


def test_rows_come_back_whole_and_the_oldest_go_first() -> None:
    buffer = RowBuffer(capacity=4 * STEPS + 1, slice_len=STEPS, batch_size=50, seed=0)
    with pytest.raises(ValueError, match="no row yet"):
        buffer.sample()
    data = rows(0, 6)
    assert buffer.extend(data[:3]) == 3 * STEPS and buffer.extend(data[3:]) == 3 * STEPS
    cues = buffer.sample()["next", "privileged"][..., 3]
    assert (cues == cues[:, :1]).all()
    kept = data["privileged"][2:, 0, 3]
    assert {float(x) for x in cues[:, 0]} == {float(x) for x in kept}
    again = RowBuffer(capacity=4 * STEPS + 1, slice_len=STEPS, batch_size=50, seed=3)
    again.load_state_dict(buffer.state_dict())
    for one in (buffer, again):
        one.extend(rows(1, 1))
    assert torch.equal(buffer.sample()["action"], again.sample()["action"])
    with pytest.raises(ValueError, match="do not fit a buffer of 4 of 6 steps"):
        buffer.extend(rows(0)[:, :3])
