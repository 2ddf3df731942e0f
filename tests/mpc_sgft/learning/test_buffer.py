"""Slices count by one, never cross an episode, and are uniform over frames; a reference found by brute force agrees."""

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from mpc_sgft.learning.buffer import make_buffer


def steps(episode, first, count, invalid=()):
    """One episode's consecutive steps, [count]; the observation counts."""
    step = torch.arange(first, first + count)
    flag = torch.zeros(count, 1, dtype=torch.bool)
    bad = torch.isin(step, torch.tensor(list(invalid), dtype=torch.long)).unsqueeze(-1)
    following = {"observation": (1000.0 * episode + step + 1).unsqueeze(-1), "done": flag, "invalid": bad}
    return TensorDict(
        {
            "observation": (1000.0 * episode + step).unsqueeze(-1),
            "episode": torch.full((count,), episode),
            "step": step,
            "next": TensorDict(following, [count]),
        },
        [count],
    )


def stored(buffer):
    """(episode, step) of every row in the ring."""
    data = buffer.state_dict()["data"]
    return list(zip(data["episode"].tolist(), data["step"].tolist(), strict=True))


def possible_starts(buffer, slice_len):
    rows = set(stored(buffer))
    return {(e, s) for e, s in rows if all((e, s + j) in rows for j in range(slice_len))}


def assert_slices_are_exactly_the_possible_ones(buffer, slice_len, batches=60):
    seen = set()
    for _ in range(batches):
        batch = buffer.sample()
        assert batch["step"].shape[1] == slice_len
        assert (batch["step"].diff(dim=1) == 1).all()
        assert (batch["episode"] == batch["episode"][:, :1]).all()
        assert (batch["next", "observation"] == batch["observation"] + 1).all()
        assert torch.equal(batch["observation"].squeeze(-1), 1000.0 * batch["episode"] + batch["step"])
        seen |= set(zip(batch["episode"][:, 0].tolist(), batch["step"][:, 0].tolist(), strict=True))
    assert seen == possible_starts(buffer, slice_len)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("slice_len", [1, 2, 3, 5])
@pytest.mark.parametrize("capacity", [23, 64, 1000])
def test_slices_of_episodes_in_pieces_interleaved_and_wrapped(slice_len, capacity, device):
    """Four environments with episodes of all lengths arrive in chunks of all lengths; the ring wraps many times."""
    generator = torch.Generator().manual_seed(capacity + slice_len)
    buffer = make_buffer(capacity, slice_len, 512, seed=0, device=device)
    episodes, position, new = [0, 1, 2, 3], [0, 0, 0, 0], 4
    for _ in range(60):
        count = int(torch.randint(1, 5, (), generator=generator))
        buffer.extend(torch.stack([steps(e, p, count) for e, p in zip(episodes, position, strict=True)]))  # [N, T]
        for i in range(4):
            position[i] += count
            if torch.rand((), generator=generator) < 0.2:
                episodes[i], position[i], new = new, 0, new + 1
    assert len(buffer) == min(capacity, len(stored(buffer)))
    assert len(buffer.sampler.tails) <= len({e for e, _ in stored(buffer)})
    assert_slices_are_exactly_the_possible_ones(buffer, slice_len)


def test_starts_are_uniform_over_frames_not_over_episodes():
    buffer = make_buffer(100, 3, 500, seed=0)
    for episode, length in enumerate([3, 4, 30, 2, 12]):
        buffer.extend(steps(episode, 0, length))
    starts = sorted(possible_starts(buffer, 3))
    assert len(starts) == 1 + 2 + 28 + 0 + 10
    counts = dict.fromkeys(starts, 0)
    for _ in range(100):
        batch = buffer.sample()
        for key in zip(batch["episode"][:, 0].tolist(), batch["step"][:, 0].tolist(), strict=True):
            counts[key] += 1
    assert chisquare(list(counts.values())).pvalue > 1e-3


def test_invalid_steps_are_dropped_and_nothing_bridges_them():
    buffer = make_buffer(100, 2, 64, seed=0)
    assert buffer.extend(steps(0, 0, 10, invalid=[4])) == 9
    assert (0, 4) not in stored(buffer)
    assert_slices_are_exactly_the_possible_ones(buffer, 2)
    assert (0, 3) not in possible_starts(buffer, 2)


def test_all_steps_invalid_store_nothing():
    assert make_buffer(100, 2, 64, seed=0).extend(steps(0, 0, 3, invalid=[0, 1, 2])) == 0


def test_extend_leaves_the_callers_data_alone():
    data = steps(0, 0, 5)
    keys = set(data.keys())
    make_buffer(100, 2, 64, seed=0).extend(data)
    assert set(data.keys()) == keys


@pytest.mark.parametrize("filled", [7, 40, 333])
def test_resume_is_exact_also_after_a_wrap(filled):
    buffer = make_buffer(50, 3, 16, seed=0)
    for episode in range(filled // 7):
        buffer.extend(steps(episode, 0, 7))
    buffer.sample()
    twin = make_buffer(50, 3, 16, seed=99)
    twin.load_state_dict(buffer.state_dict())
    for b in (buffer, twin):
        b.extend(steps(filled // 7 - 1, 7, 4))  # the last episode goes on after the resume
    assert len(buffer) == len(twin)
    for _ in range(5):
        assert torch.equal(buffer.sample()["observation"], twin.sample()["observation"])


@pytest.mark.parametrize("capacity", [21, 90])
def test_what_was_not_full_goes_on_in_another_size(capacity):
    buffer = make_buffer(50, 3, 16, seed=0)
    buffer.extend(steps(0, 0, 12))
    twin = make_buffer(capacity, 3, 16, seed=1)
    twin.extend(steps(7, 0, 20))
    twin.load_state_dict(buffer.state_dict())
    twin.extend(steps(0, 12, 6))
    assert len(twin) == 18 and stored(twin) == [(0, t) for t in range(18)]
    assert_slices_are_exactly_the_possible_ones(twin, 3)
    full = make_buffer(18, 3, 16, seed=0)
    full.extend(steps(0, 0, 18))
    for size, saved in ((60, full), (17, twin)):
        with pytest.raises(ValueError, match=f"room for {size}; keep the capacity"):
            make_buffer(size, 3, 16, seed=0).load_state_dict(saved.state_dict())


def test_errors_say_what_came_and_what_is_allowed():
    buffer = make_buffer(5, 3, 16, seed=0)
    buffer.extend(steps(0, 0, 2))
    with pytest.raises(ValueError, match="2 steps but no 3 consecutive"):
        buffer.sample()
    with pytest.raises(ValueError, match="6 transitions do not fit a buffer of 5"):
        buffer.extend(steps(1, 0, 6))
    with pytest.raises(ValueError, match="slice_len"):
        make_buffer(2, 3, 16, seed=0)
