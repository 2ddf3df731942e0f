"""What a person says of a rollout, in the real loop on the simulator: what counts, what is undone, what is recorded."""

import csv
import json
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig
from safetensors.torch import load_file

from envs.backends.base import BackendError
from mpc_sgft import deploy as front
from mpc_sgft.command import compose, resumed
from mpc_sgft.command.errors import Stopped, UserError
from mpc_sgft.learning.transfer import Transfer
from mpc_sgft.runs import build, deploy
from mpc_sgft.session.corrections import amend
from mpc_sgft.session.operator import Nobody
from mpc_sgft.storage import checkpoint
from mpc_sgft.storage.episode_file import EpisodeWriter, read_episode
from mpc_sgft.storage.rollout import Press, Rollout, from_episode
from tests.mpc_sgft.views.test_viewer import columns

STEPS = 8
SMALL = [f"task.env.episode_steps={STEPS}", "planner=policy", "method.updates=3", "eval_episodes=2", "quiet=true"]
SMALL += ["log.tensorboard=false", "log.rerun=false", "train.replay.batch_size=8", "rollouts=2", "method.gate=false"]


SESSIONS: list[int] = []


class Script:
    """An operator whose keys are known beforehand: (phase, episode) -> words, each once; and answers to questions."""

    present, stopping, guiding = True, False, False

    def __init__(self, keys: dict[tuple[str, int], list[str]], answers: list[str] | None = None):
        self.keys, self.answers, self.presses, self.episode = dict(keys), list(answers or ()), [], 0
        nobody = Nobody()
        self.rest, self.track, self.tell, self.halt = nobody.rest, nobody.track, nobody.tell, nobody.halt
        self.heed = nobody.heed

    def enter(self, phase: str, episode: int) -> None:
        self.episode = episode
        self.presses += [Press(word, 1e9, episode) for word in self.keys.pop((phase, episode), ())]

    def poll(self) -> list[Press]:
        taken, self.presses = self.presses, []
        return taken

    def ask(self) -> bool:
        self.presses.append(Press(self.answers.pop(0), 1e9, self.episode))
        return True


def broken_at(last: int, error: type[BaseException], *words: str) -> Callable[..., Rollout]:
    """`deploy.drive` that breaks down where a rollout begins."""
    drive = deploy.drive

    def broken(*args, number: int, **more):
        if number == last:
            raise error(*words)
        return drive(*args, number=number, **more)

    return broken


def run(folder: Path, operator: Script | None, *more: str, judged: bool = True) -> dict:
    return loop(compose.compose("deploy", [*SMALL, f"run_dir={folder}", *more], []), operator, judged)


def go_on(folder: Path, operator: Script | None, *more: str) -> dict:
    """Resume a run that nobody judges."""
    return loop(resumed.resume("deploy", str(folder), more, more), operator, judged=False)


def loop(cfg: DictConfig, operator: Script | None, judged: bool) -> dict:
    agent, _ = build.load_agent(cfg)
    env, judge = build.make_env(cfg, 1), build.make_env(cfg, 2) if judged else None
    SESSIONS.append(len(SESSIONS) + 1)
    report = {"session": SESSIONS[-1]}
    env.backend.report = lambda: report  # as a robot's, which nobody judges, has one
    return deploy.Deployment(cfg, agent, env, judge, operator).loop()


def rows(folder: Path, name: str) -> list[dict]:
    with (folder / name).open() as file:
        return [{k: v for k, v in row.items() if k not in ("planner_ms", "seconds")} for row in csv.DictReader(file)]


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "checkpoint" / "model.safetensors")


def learned(folder: Path) -> list[tuple[int, bool]]:
    """Which rollouts were learned from, and whether they count as successes there."""
    state = checkpoint.load_state(folder / "checkpoint" / "state.pt")
    return [(verdict["episode"], verdict["success"]) for verdict in state["transfer"]["verdicts"]]


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "plain"
    run(folder, None)
    return folder


@pytest.mark.parametrize("when", ["running", "resetting"])
def test_a_rollout_driven_again_leaves_no_trace_in_what_was_learned(plain, tmp_path, when):
    summary = run(tmp_path / "r", Script({(when, 1): ["rerecord"]}))
    assert (summary["real_rollouts"], summary["rerecorded"]) == (2, 1)
    names = sorted(p.name for p in (tmp_path / "r" / "episodes").iterdir())
    assert names == ["0001.mcap", "0001.rerecorded1.mcap", "0002.mcap"]
    aside = read_episode(tmp_path / "r" / "episodes" / "0001.rerecorded1.mcap")
    assert aside.complete and [k["key"] for k in aside.keys] == ["rerecord"]
    ours, theirs = weights(tmp_path / "r"), weights(plain)
    assert all(torch.equal(ours[k], theirs[k]) for k in theirs)
    spent = checkpoint.load_state(tmp_path / "r" / "checkpoint" / "state.pt")["loop"]["spent"]
    assert {k: round(v, 1) for k, v in spent.items()} == pytest.approx(summary["seconds"], abs=0.11)
    for name in ("metrics.csv", "audit.csv"):
        assert rows(tmp_path / "r", name) == rows(plain, name), name


def test_a_mark_after_an_undo_changes_the_rollout_before_alone(tmp_path):
    class Marked(Script):
        def enter(self, phase: str, episode: int) -> None:
            super().enter(phase, episode)
            if (phase, episode) == ("resetting", 2):
                self.keys["resetting", 1] = ["success"]

    run(tmp_path / "plain", None, "rollouts=3")
    run(tmp_path / "r", Marked({("resetting", 2): ["rerecord"]}), "rollouts=3")
    before, after = (rows(tmp_path / name, "metrics.csv") for name in ("plain", "r"))
    assert before[0].pop("real_success") == "0.0" and after[0].pop("real_success") == "1.0"
    assert after[0] == before[0]


def test_what_is_left_of_a_session_goes_on_with_more_rollouts(tmp_path):
    """As on a robot: the real rollouts are the measure. A mark of the last one keeps what was measured of it."""
    folder = tmp_path / "r"
    SESSIONS.clear()
    run(folder, None, "rollouts=2", "eval_every=1", judged=False)
    before = rows(folder, "metrics.csv")
    with pytest.raises(UserError, match="rollouts=1: .* has 2 already. Give as many or more"):
        go_on(folder, None, "rollouts=1")
    go_on(folder, Script({("resetting", 2): ["success"]}), "rollouts=3")
    after = rows(folder, "metrics.csv")
    assert after[:2] == before and len(after) == 3, "what an earlier process measured stays"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["robot"] == {"session": 3} and summary["robot_before"] == [{"session": 1}]  # 2 was refused
    assert learned(folder) == [(1, False), (2, True), (3, False)]
    path = folder / "checkpoint" / "state.pt"
    state = checkpoint.load_state(path)
    del state["transfer"]["verdicts"][0]["episode"]
    checkpoint.save_state(path, state)
    with pytest.raises(UserError, match="an earlier version wrote it"):
        go_on(folder, None)


@pytest.mark.parametrize("judged", [True, False])
def test_a_run_that_ends_earlier_than_it_was_told_is_measured_at_its_end(tmp_path, monkeypatch, judged):
    drive = deploy.drive
    monkeypatch.setattr(deploy, "drive", broken_at(3, RuntimeError, "the line is dead"))
    with pytest.raises(RuntimeError, match="the line is dead"):
        run(tmp_path / "r", None, "rollouts=4", "eval_every=4", judged=judged)
    monkeypatch.setattr(deploy, "drive", drive)
    ours = loop(resumed.resume("deploy", str(tmp_path / "r"), ["rollouts=2"], ["rollouts=2"]), None, judged)
    theirs = run(tmp_path / "whole", None, "rollouts=2", "eval_every=4", judged=judged)
    assert ours["curve"] == theirs["curve"] and set(ours["curve"]) == ({"0", "2"} if judged else {"2"})
    assert ours["evaluation_episodes"] == theirs["evaluation_episodes"] == 2


def test_what_the_viewer_was_shown_is_taken_back_or_corrected(tmp_path, monkeypatch):
    def texts(folder: Path) -> list[str]:
        return [text for (text,) in columns(folder / "run.rrd")["/episodes"]["TextLog:text"]]

    run(tmp_path / "m", Script({("resetting", 1): ["success"]}), "log.rerun=true")
    assert texts(tmp_path / "m")[1] == "0 counts as a success"
    assert columns(tmp_path / "m" / "run.rrd")["/success"]["Scalars:scalars"][:2] == [[0.0], [1.0]]
    measure, measured = deploy.Deployment._measure, []

    def killed(self, rollout, number):
        measured.append(number)
        if measured == [1, 1]:
            raise RuntimeError("killed")
        return measure(self, rollout, number)

    monkeypatch.setattr(deploy.Deployment, "_measure", killed)
    with pytest.raises(RuntimeError, match="killed"):
        run(tmp_path / "r", Script({("resetting", 1): ["rerecord"]}), "log.rerun=true")
    monkeypatch.undo()
    loop(resumed.resume("deploy", str(tmp_path / "r"), [], []), None, judged=True)
    said = texts(tmp_path / "r")
    assert said[1] == "0 does not count: it is driven again"
    assert [text.partition(". ")[2] for text in said if ". " in text] == ["rollout 1", "rollout 1", "rollout 2"]


def test_a_finished_run_that_goes_on_has_no_summary_until_it_is_finished_again(tmp_path, monkeypatch):
    folder, drive = tmp_path / "r", deploy.drive
    run(folder, None, "rollouts=1", judged=False)
    before = (folder / "summary.json").read_bytes()
    with pytest.raises(UserError, match="Give as many or more"):
        go_on(folder, None, "rollouts=0")
    assert (folder / "summary.json").read_bytes() == before
    monkeypatch.setattr(deploy, "drive", broken_at(3, KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        go_on(folder, None, "rollouts=4")
    assert not (folder / "summary.json").exists()
    monkeypatch.setattr(deploy, "drive", drive)
    for _ in range(2):  # the second time there is nothing left to do
        assert go_on(folder, None) == json.loads((folder / "summary.json").read_text())


def test_what_a_rollout_that_breaks_down_leaves_behind(tmp_path, monkeypatch):
    """The mark of the one before is kept; one that was measured and not learned from is not audited twice."""
    drive, learn = deploy.drive, Transfer.learn
    monkeypatch.setattr(deploy, "drive", broken_at(2, RuntimeError, "the line is dead"))
    with pytest.raises(RuntimeError, match="the line is dead"):
        run(tmp_path / "r", Script({("resetting", 1): ["success"]}), judged=False)
    assert read_episode(tmp_path / "r" / "episodes" / "0001.mcap").outcome["success"] is True
    assert [row["real_success"] for row in rows(tmp_path / "r", "metrics.csv")] == ["1.0"]
    monkeypatch.setattr(deploy, "drive", drive)
    monkeypatch.setattr(Transfer, "learn", lambda *_, **__: (_ for _ in ()).throw(FloatingPointError("not finite")))
    with pytest.raises(FloatingPointError):
        go_on(tmp_path / "r", None)
    monkeypatch.setattr(Transfer, "learn", learn)
    go_on(tmp_path / "r", None)
    audited = [(row["rollout"], row["step"]) for row in rows(tmp_path / "r", "audit.csv")]
    assert audited == [(str(n), str(t)) for n in (1, 2) for t in range(1, STEPS + 1)]


@pytest.mark.parametrize("error", [BackendError, KeyboardInterrupt, SystemExit])
def test_a_mark_during_a_reset_is_kept_and_the_machine_at_rest(tmp_path, monkeypatch, error):
    order, begin, late = [], deploy.begin, deploy.Verdicts.late

    def broken(env, seed):
        if order:
            env.backend.close = lambda: order.append("closed")
            raise error
        order.append("first")
        return begin(env, seed)

    monkeypatch.setattr(deploy, "begin", broken)
    monkeypatch.setattr(deploy.Verdicts, "late", lambda self, n: (order.append(n), late(self, n))[1])
    with pytest.raises(error):
        run(tmp_path / "r", Script({("resetting", 1): ["success"]}))
    assert order[-2:] == ["closed", 1]
    assert read_episode(tmp_path / "r" / "episodes" / "0001.mcap").outcome["success"] is True
    assert learned(tmp_path / "r") == [(1, True)]


def test_a_deployment_gives_ctrl_c_back(tmp_path):
    before = signal.getsignal(signal.SIGINT)
    assert deploy.deploy(compose.compose("deploy", [*SMALL, f"run_dir={tmp_path / 'r'}", "rollouts=1"], [])) == 0
    assert signal.getsignal(signal.SIGINT) is before


def test_a_resumed_run_that_finds_the_disk_full_says_so_and_gives_ctrl_c_back(plain, tmp_path, capsys):
    folder, before = shutil.copytree(plain, tmp_path / "r"), signal.getsignal(signal.SIGINT)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size, file in ((50, "metrics.csv"), ((plain / "metrics.csv").stat().st_size, "config.yaml")):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
        try:
            assert front.main(["--resume", str(folder), "rollouts=3"]) == 2
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        said = capsys.readouterr().err
        assert f"{folder / file}: files may not grow" in said and "the same --resume goes on" in said, said
        assert signal.getsignal(signal.SIGINT) is before and "run_dir" not in said
    assert (folder / "summary.json").read_bytes() == (plain / "summary.json").read_bytes()


@pytest.mark.parametrize("key", ["rerecord", None])
def test_after_ctrl_c_no_other_rollout_begins(tmp_path, monkeypatch, key):
    """Not either where the one that is running is to be driven again."""
    driven, drive = [], deploy.drive

    def stopped(*args, number: int, **more):
        driven.append(number)
        found = drive(*args, number=number, **more)
        signal.raise_signal(signal.SIGINT)
        return found

    monkeypatch.setattr(deploy, "drive", stopped)
    with pytest.raises(Stopped, match=f"saved after {0 if key else 1} rollouts"):
        run(tmp_path / "r", Script({("running", 1): [key]} if key else {}))
    assert driven == [1]


@pytest.mark.parametrize("when", ["training", "resetting"])
def test_a_mark_overrides_what_the_task_computed(tmp_path, when):
    operator = Script({(when, 1): ["failure", "success"]})
    run(tmp_path / "r", operator)
    marked, other = (read_episode(tmp_path / "r" / "episodes" / f"000{n}.mcap") for n in (1, 2))
    assert marked.outcome["success"] is True and marked.outcome["task_success"] is False
    assert [k["key"] for k in marked.keys] == ["failure", "success"] and len(marked.transitions["step"]) == STEPS
    assert other.outcome["success"] is False and not other.keys
    assert [row["real_success"] for row in rows(tmp_path / "r", "metrics.csv")] == ["1.0", "0.0"]
    assert learned(tmp_path / "r") == [(1, True), (2, False)]


def test_a_person_is_asked_after_each_episode(tmp_path):
    operator = Script({}, ["success", "rerecord", "failure"])
    summary = run(tmp_path / "r", operator, "success=ask")
    assert not operator.answers and summary["rerecorded"] == 1
    assert [row["real_success"] for row in rows(tmp_path / "r", "metrics.csv")] == ["1.0", "0.0"]
    assert learned(tmp_path / "r") == [(1, True), (2, False)]
    assert json.loads((tmp_path / "r" / "summary.json").read_text()) == summary


def test_a_question_that_was_not_answered_is_asked_when_the_session_goes_on(tmp_path):
    class Leaves(Script):
        def ask(self) -> bool:
            self.stopping = True
            return False

    folder = tmp_path / "r"
    with pytest.raises(Stopped, match="saved after 0 rollouts"):
        run(folder, Leaves({}), "success=ask", judged=False)
    assert (folder / "episodes" / "0001.mcap").exists()
    go_on(folder, Script({}, ["success", "failure"]))
    assert learned(folder) == [(1, True), (2, False)]


def test_a_pause_is_heeded_before_every_reset(tmp_path):
    class Watched(Script):
        def __init__(self, keys: dict[tuple[str, int], list[str]]):
            super().__init__(keys)
            self.seen: list[str] = []
            self.rest = lambda: self.seen.append("rest")

        def enter(self, phase: str, episode: int) -> None:
            super().enter(phase, episode)
            self.seen.append(phase)

    operator = Watched({("running", 1): ["rerecord"]})
    run(tmp_path / "r", operator)
    before = [operator.seen[i - 1] for i, phase in enumerate(operator.seen) if phase == "resetting"]
    assert before == ["rest"] * 3  # the first, the one driven again, the second


def test_an_episode_that_an_end_of_the_program_broke_off_is_no_success(tmp_path):
    row = {"step": 0, "time": 0.2, "action": [0.0], "action_sent": [0.0], "reward": 0.0, "terminated": False}
    row |= {"truncated": False, "success": True, "invalid": False, "observation": [0.0], "next_observation": [0.0]}
    with pytest.raises(SystemExit), EpisodeWriter(tmp_path / "0.mcap", {}) as writer:
        writer.step(row, None)
        raise SystemExit(143)
    rollout = from_episode(read_episode(tmp_path / "0.mcap"), 1)
    assert rollout.aborted and not rollout.success


def test_an_episode_that_was_cut_off_is_amended_with_what_was_lost(plain, tmp_path):
    whole = (plain / "episodes" / "0001.mcap").read_bytes()
    path = tmp_path / "0001.mcap"
    path.write_bytes(whole[: len(whole) // 2])
    before = read_episode(path)
    amend(path, [Press("failure", before.metadata["began_unix"] + 2.5, 1)], False)
    after = read_episode(path)
    assert after.complete and after.outcome["aborted"] == "cut off" and after.outcome["lost"] == before.lost
    assert after.keys[0]["time"] == 2.5 and list(tmp_path.iterdir()) == [path]
    assert len(after.transitions["step"]) == len(before.transitions["step"]) > 0


def test_what_a_person_moved_is_read_back(tmp_path):
    with EpisodeWriter(tmp_path / "0.mcap", {}) as writer:
        for k in range(2):
            writer.guided({"time": [k, k + 0.5], "object": [[0.0, 1.0, float("nan")]] * 2})
        writer.close({})
    found = read_episode(tmp_path / "0.mcap").guided
    assert found["time"].tolist() == [0, 0.5, 1, 1.5] and found["object"].shape == (4, 3)
