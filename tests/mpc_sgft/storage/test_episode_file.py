import errno
import json
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from mpc_sgft.session.corrections import amend
from mpc_sgft.storage.episode_file import EpisodeWriter, read_episode
from mpc_sgft.storage.rollout import Press

METADATA = {"task": "push", "joint_names": ["a", "b"], "seed": 3, "control_dt": 0.2}


def transition(step: int) -> dict:
    rng = np.random.default_rng(step)
    return {
        "step": step,
        "time": 0.2 * step,
        "observation": rng.normal(size=4).astype(np.float32),
        "action": rng.normal(size=2).astype(np.float32),
        "action_sent": rng.normal(size=2).astype(np.float32),
        "reward": np.float32(-0.1 * step),
        "terminated": np.array(False),
        "truncated": step == 9,
        "success": step > 5,
        "next_observation": rng.normal(size=4).astype(np.float32),
    }


def samples(step: int, rows: int = 5) -> dict:
    time_ = 0.2 * step + np.linspace(0, 0.2, rows, endpoint=False)
    return {"time": time_, "qpos": np.stack([time_, -time_], 1), "ctrl": np.ones((rows, 1)) * step}


def write(path, steps: int = 10) -> None:
    with EpisodeWriter(path, METADATA) as writer:
        for k in range(steps):
            writer.step(transition(k), samples(k))
        writer.close({"success": True, "return": -1.5})


def same(episode, steps: int) -> None:
    """The first `steps` steps of write() and nothing else."""
    for key in transition(0) if steps else ():
        expected = np.array([transition(k)[key] for k in range(steps)])
        assert np.array_equal(episode.transitions[key], expected), key
    for key in samples(0) if steps else ():
        assert np.array_equal(episode.joints[key], np.concatenate([samples(k)[key] for k in range(steps)])), key
    assert steps or not episode.transitions


def plain(episode) -> str:
    """All that was read, to be compared."""
    tables = ({k: v.tolist() for k, v in x.items()} for x in (episode.transitions, episode.joints, episode.guided))
    return json.dumps([*tables, episode.metadata, episode.outcome, episode.keys])


def test_round_trip_is_exact(tmp_path):
    write(tmp_path / "0.mcap")
    episode = read_episode(tmp_path / "0.mcap")
    same(episode, 10)
    assert episode.metadata == METADATA
    assert episode.outcome == {"success": True, "return": -1.5}
    assert episode.complete and episode.lost is None
    assert episode.transitions["success"].dtype == bool
    assert episode.transitions["step"].dtype == np.int64
    assert episode.joints["qpos"].shape == (50, 2)


def test_ordinary_mcap_readers_understand_the_file(tmp_path):
    write(tmp_path / "0.mcap")
    with (tmp_path / "0.mcap").open("rb") as file:
        found = [(c.topic, m.log_time, json.loads(m.data)) for _, c, m in make_reader(file).iter_messages()]
    steps = [(log_time, data["step"]) for topic, log_time, data in found if topic == "/transition"]
    assert steps == [(k * 200_000_000, k) for k in range(10)]


def test_keys_and_a_takeover_are_stamped_when_they_were(tmp_path):
    """And an episode that is amended keeps its stamps and counts."""

    def stamps() -> list[tuple[str, float, int]]:
        with (tmp_path / "0.mcap").open("rb") as file:
            found = [(c.topic, m.log_time / 1e9, m.sequence) for _, c, m in make_reader(file).iter_messages()]
        return found[1:]  # metadata

    with EpisodeWriter(tmp_path / "0.mcap", METADATA | {"began_unix": 1000.0}) as writer:
        for k in range(2):
            writer.step(transition(k), samples(k))
        writer.key("takeover", time=0.35, unix=1000.35)
        for begin in (5.0, 15.0):
            writer.guided({"time": begin + np.array([0, 0.1])})
        writer.key("confirm", time=15.05, unix=1015.05)  # while the samples came
        writer.key("takeover", time=31.0, unix=1031.0)
        writer.close({})
    steps = [(topic, 0.2 * k, k) for k in range(2) for topic in ("/transition", "/joints")]
    person = [("/keys", 0.35, 2), ("/guided", 5.1, 2), ("/guided", 15.1, 2), ("/keys", 15.1, 2)]
    before = stamps()
    assert before == [*steps, *person, ("/outcome", 15.1, 2), ("/keys", 31.0, 2)]
    amend(tmp_path / "0.mcap", [Press("success", 1040.0, 1)], True)
    assert [stamp for stamp in stamps() if stamp[0] != "/outcome"] == [
        *(stamp for stamp in before if stamp[0] != "/outcome"),
        ("/keys", 40.0, 2),
    ]


def test_what_is_not_finite_comes_back_as_nan(tmp_path):
    with EpisodeWriter(tmp_path / "0.mcap", METADATA | {"noise": float("nan")}) as writer:
        writer.step(transition(0) | {"reward": np.float32("nan")}, {"time": [0.0], "force": [[1.0, np.inf]]})
    episode = read_episode(tmp_path / "0.mcap")
    assert np.isnan(episode.transitions["reward"]).all()
    assert episode.joints["force"][0, 0] == 1.0 and np.isnan(episode.joints["force"][0, 1])
    assert episode.metadata["noise"] is None


def test_without_joints(tmp_path):
    with EpisodeWriter(tmp_path / "0.mcap", METADATA) as writer:
        writer.step(transition(0))
    episode = read_episode(tmp_path / "0.mcap")
    assert episode.joints == {} and episode.outcome == {} and episode.complete


def test_an_exception_closes_the_file_and_is_the_outcome(tmp_path):
    with pytest.raises(RuntimeError), EpisodeWriter(tmp_path / "0.mcap", METADATA) as writer:
        writer.step(transition(0), samples(0))
        raise RuntimeError("cable out")
    episode = read_episode(tmp_path / "0.mcap")
    same(episode, 1)
    assert episode.outcome == {"aborted": "RuntimeError: cable out"}


def test_mistakes_are_named(tmp_path):
    with pytest.raises(ValueError, match="gap"):
        EpisodeWriter(tmp_path / "g.mcap", {"gap": "slippery"})
    assert not (tmp_path / "g.mcap").exists()
    with EpisodeWriter(tmp_path / "0.mcap", METADATA) as writer:
        with pytest.raises(ValueError, match="action_sent"):
            writer.step({k: v for k, v in transition(0).items() if k != "action_sent"})
        with pytest.raises(ValueError, match="same number of rows"):
            writer.step(transition(0), samples(0) | {"qpos": np.zeros((3, 2))})
        writer.step(transition(0), samples(0))
        with pytest.raises(ValueError, match="camera"):
            writer.step(transition(1) | {"camera": 1})
        with pytest.raises(ValueError, match="Transition 1 has step=2; steps count from 0"):
            writer.step(transition(2))
    with pytest.raises(ValueError, match="closed"):
        writer.step(transition(1))
    same(read_episode(tmp_path / "0.mcap"), 1)
    with pytest.raises(FileExistsError, match="0.mcap"):
        EpisodeWriter(tmp_path / "0.mcap", METADATA)
    (tmp_path / "x.mcap").write_text("time,qpos\n")
    with pytest.raises(ValueError, match="not an MCAP file"):
        read_episode(tmp_path / "x.mcap")


KILLED = """
import sys, time
from tests.mpc_sgft.storage.test_episode_file import EpisodeWriter, METADATA, samples, transition
writer = EpisodeWriter(sys.argv[1], METADATA)
for k in range(10_000):
    writer.step(transition(k), samples(k))
    print(k, flush=True)
    time.sleep(0.002)
"""


def test_sigkill_loses_at_most_the_step_in_flight(tmp_path):
    path = tmp_path / "0.mcap"
    command = [sys.executable, "-c", KILLED, str(path)]
    process = subprocess.Popen(command, cwd=Path(__file__).parents[3], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for _ in range(20):
        process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    assert process.wait(timeout=30) == -signal.SIGKILL
    reported = 20 + len(process.stdout.read().split())
    episode = read_episode(path)
    steps = len(episode.transitions["step"])
    assert steps - reported in (0, 1)  # written before it was reported
    same(episode, steps)
    assert not episode.complete and episode.outcome is None
    assert f"{steps} whole steps" in episode.lost and "never closed" in episode.lost


def test_any_cut_keeps_every_whole_step(tmp_path):
    path, cut = tmp_path / "0.mcap", tmp_path / "cut.mcap"
    ends = []  # size of the file after each step
    with EpisodeWriter(path, METADATA) as writer:
        for k in range(6):
            writer.step(transition(k), samples(k))
            ends.append(path.stat().st_size)
        writer.close({"success": True})
    data = path.read_bytes()
    offsets = [*range(0, len(data), 7), *(e + d for e in ends for d in (-1, 0, 1)), len(data) - 1]
    for offset in offsets:
        cut.write_bytes(data[:offset])
        episode = read_episode(cut)
        whole = sum(end <= offset for end in ends)
        steps = len(episode.transitions.get("step", ()))
        assert whole <= steps <= whole + 1, offset  # a chunk is whole a few index bytes before the flush ends
        same(episode, steps)
        assert not episode.complete and f"{steps} whole steps" in episode.lost


@pytest.mark.parametrize("part", [0.3, 0.4, 0.5, 0.6])
def test_a_flipped_bit_is_reported_and_earlier_steps_kept(tmp_path, part):
    path = tmp_path / "0.mcap"
    write(path)
    data = bytearray(path.read_bytes())
    data[int(part * len(data))] ^= 0x10
    path.write_bytes(data)
    episode = read_episode(path)
    steps = len(episode.transitions["step"])
    assert 0 < steps < 10 and ("damaged" in episode.lost or "middle of a record" in episode.lost)
    same(episode, steps)


def test_no_bit_that_flips_goes_unsaid_or_ends_in_another_error(tmp_path):
    """What is read is all there was, or is told to be less and then begins as the episode did."""
    path, rng = tmp_path / "0.mcap", np.random.default_rng(0)
    with EpisodeWriter(path, METADATA) as writer:
        for k in range(2):
            writer.step(transition(k), samples(k))
        writer.key("success", time=0.5, unix=1000.5)
        writer.guided(samples(2))
        writer.close({"success": True})
    whole, good = path.read_bytes(), plain(read_episode(path))
    index = whole.rindex(b"mpc_sgft.metadata")  # repeated behind the data
    places = [(at, rng.integers(8)) for at in (*range(index), *range(index, len(whole), 5))]
    for at, bit in [*places, (whole.rindex(b"/metadata") - 17, 0)]:  # the last makes a message of a channel
        data = bytearray(whole)
        data[at] ^= 1 << bit
        path.write_bytes(data)
        try:
            episode = read_episode(path)
        except ValueError as error:
            assert "0.mcap is" in str(error) and at < 32, (at, error)  # no MCAP, or none with our topics
            continue
        assert not episode.complete or plain(episode) == good, at
        same(episode, len(episode.transitions.get("step", ())))


def test_steps_after_one_that_is_missing_do_not_count(tmp_path):
    """Where a file was never closed nothing counts what is in it."""
    path, ends = tmp_path / "0.mcap", []
    with EpisodeWriter(path, METADATA) as writer:
        for k in range(4):
            writer.step(transition(k), samples(k))
            ends.append(path.stat().st_size)
        writer.key("success", time=0.5, unix=1000.5)
        end = path.stat().st_size
    data = path.read_bytes()
    path.write_bytes(data[: ends[1]] + data[ends[2] : end])
    episode = read_episode(path)
    same(episode, 2)
    assert "step 2 is missing: 2 whole steps" in episode.lost and [row["key"] for row in episode.keys] == ["success"]


def test_a_full_disk_names_the_file_and_keeps_the_steps_before(tmp_path):
    path = tmp_path / "0.mcap"
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    with EpisodeWriter(path, METADATA) as writer:
        writer.step(transition(0), samples(0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 4500, limit[1]))
        try:
            with pytest.raises(OSError, match="0.mcap") as caught:
                for k in range(1, 50):
                    writer.step(transition(k), samples(k))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        assert caught.value.errno in (errno.EFBIG, errno.ENOSPC)
        assert f"{writer.steps} steps of the episode are kept" in str(caught.value)
    episode = read_episode(path)
    steps = len(episode.transitions["step"])
    assert steps - writer.steps in (0, 1) and writer.steps > 0  # data may fit where the index after it did not
    same(episode, steps)
    with pytest.raises(OSError, match="nowhere"):
        EpisodeWriter(tmp_path / "nowhere" / "0.mcap", METADATA)


def test_a_step_is_cheap(tmp_path):
    """A tenth of a 5 Hz step would be too much; measured 0.5 ms with 20 rows of 29 numbers."""
    rows = {"time": np.arange(20.0)} | {key: np.random.default_rng(0).normal(size=(20, 7)) for key in ("qpos", "qvel")}
    with EpisodeWriter(tmp_path / "0.mcap", METADATA) as writer:
        costs = []
        for k in range(20):
            start = time.perf_counter()
            writer.step(transition(k), rows)
            costs.append(time.perf_counter() - start)
    assert np.median(costs) < 0.02
