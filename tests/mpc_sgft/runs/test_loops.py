"""The three commands as real processes, on the pendulum with tiny networks."""

import contextlib
import copy
import csv
import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import load_file

from mpc_sgft import deploy, evaluate, pretrain
from mpc_sgft.command.errors import UserError
from mpc_sgft.learning.transfer import Transfer, open_loop_error
from mpc_sgft.runs import evaluate as evaluating
from mpc_sgft.runs import pretrain as pretraining
from mpc_sgft.runs.collect import planner_policy
from mpc_sgft.runs.deploy import Deployment
from mpc_sgft.runs.real_rollout import drive
from mpc_sgft.storage import checkpoint
from mpc_sgft.storage.episode_file import read_episode
from mpc_sgft.storage.rollout import from_episode
from mpc_sgft.views.deploy_view import DeployViewer
from tests.mpc_sgft.views.test_viewer import columns
from tools.studies import relearn

TINY = ["+experiment=debug", "task=pendulum", "log.tensorboard=false", "log.rerun=false"]
NEEDED = "task gap method seed real_rollouts aborted_rollouts zero_shot_success final_success rollouts_to_90".split()
NEEDED += ["wall_seconds", "rrd"]


def command(name: str, *words: str) -> list[str]:
    settings = [] if "--resume" in words else TINY  # a resumed run has its own
    return [sys.executable, "-m", f"mpc_sgft.{name}", "--quiet", *settings, *words]


def run(name: str, *words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(command(name, *words), capture_output=True, text=True, timeout=240, env=environment)


def here(name: str, *words: str) -> subprocess.CompletedProcess:
    """As `run`, in this process: spares the start where a process of its own tells nothing more."""
    out, err, argv = io.StringIO(), io.StringIO(), command(name, *words)[3:]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = {"pretrain": pretrain, "deploy": deploy, "evaluate": evaluate}[name].main(argv)
    return subprocess.CompletedProcess(argv, code, out.getvalue(), err.getvalue())


def rows(folder: Path) -> list[dict]:
    with (folder / "metrics.csv").open() as file:
        return [
            {k: v for k, v in row.items() if "seconds" not in k and k != "planner_ms"} for row in csv.DictReader(file)
        ]


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    done = run("pretrain", f"run_dir={folder}")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def deployed(pretrained, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "deployed"
    words = ["gap=pendulum_torque", f"run_dir={folder}", "rollouts=4", "method.updates=25"]
    done = run("deploy", f"checkpoint={pretrained}", *words)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == json.loads((folder / "summary.json").read_text())
    return folder


def test_pretraining_resumes_with_the_same_numbers(pretrained, tmp_path):
    """The whole run had its rounds collected by another process, the resumed one by its own."""
    half = tmp_path / "half"
    assert run("pretrain", f"run_dir={half}", "transitions=960", "collector=inline").returncode == 0
    done = run("pretrain", "--resume", str(half), "transitions=1920")
    assert done.returncode == 0, done.stderr
    whole, resumed = (load_file(f / "checkpoint" / "model.safetensors") for f in (pretrained, half))
    assert all((whole[k] == resumed[k]).all() for k in whole)
    skip = {"success", "return"}  # the half run also evaluates at its own end
    ours, theirs = rows(pretrained), rows(half)
    assert [{k: v for k, v in r.items() if k not in skip} for r in ours] == [
        {k: v for k, v in r.items() if k not in skip} for r in theirs
    ]
    saved = half / "checkpoint" / "state.pt"  # these critics' range is still the least, 1: as if it had been wider
    state = checkpoint.load_state(saved)
    state["agent"]["snapshot"]["scale"] = torch.tensor(3.0)
    checkpoint.save_state(saved, state)
    assert run("pretrain", "--resume", str(half), "transitions=2400").returncode == 0
    model = checkpoint.load(half / "checkpoint" / "model.safetensors").model
    assert model.value_range == pytest.approx(float(rows(half)[-1]["scale"])) and model.value_range > 1.1


def test_a_run_that_stopped_before_it_saved_begins_again(pretrained, tmp_path):
    (tmp_path / "r").mkdir()
    for name in ("config.yaml", "metrics.csv"):  # rows of rounds that no checkpoint holds
        shutil.copy(pretrained / name, tmp_path / "r" / name)
    done = here("pretrain", "--resume", str(tmp_path / "r"))
    assert done.returncode == 0 and "begins again" in done.stdout, done.stderr
    weights, again = (load_file(f / "checkpoint" / "model.safetensors") for f in (pretrained, tmp_path / "r"))
    assert all((weights[k] == again[k]).all() for k in weights)
    assert [r["updates"] for r in rows(tmp_path / "r")] == [r["updates"] for r in rows(pretrained)]


def test_a_disk_that_fills_up_ends_pretraining_with_how_to_go_on(tmp_path, monkeypatch):
    def full(path, state):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save_state", full)
        done = here("pretrain", f"run_dir={tmp_path / 'r'}", "transitions=320", "collector=inline")
    assert done.returncode == 2 and "checkpoint/state.pt: the disk is full" in done.stderr, done.stderr
    assert f"--resume {tmp_path / 'r'}" in done.stderr and "run_dir=" not in done.stderr
    assert here("pretrain", "--resume", str(tmp_path / "r")).returncode == 0


def test_a_final_evaluation_that_was_left_plans_with_the_range_of_what_was_learned(tmp_path, monkeypatch):
    assert here("pretrain", f"run_dir={tmp_path / 'r'}", "transitions=320", "collector=inline").returncode == 0
    saved, ranges = tmp_path / "r" / "checkpoint" / "state.pt", []
    state = checkpoint.load_state(saved)
    state["agent"]["snapshot"]["scale"] = torch.tensor(3.0)
    checkpoint.save_state(saved, state)

    def watched(model, *rest):
        ranges.append(model.value_range)
        return planner_policy(model, *rest)

    monkeypatch.setattr(pretraining, "planner_policy", watched)
    assert here("pretrain", "--resume", str(tmp_path / "r")).returncode == 0
    assert ranges == [3.0, 3.0]


def test_a_run_that_held_its_target_goes_on_only_when_told_to(tmp_path):
    easy = "target_success=0.0", "target_streak=1", "min_transitions=320", "eval_every=1", "collector=inline"
    given, numbers = ["pretrain", "--resume", str(tmp_path / "r")], lambda: [r["updates"] for r in rows(tmp_path / "r")]
    assert here("pretrain", f"run_dir={tmp_path / 'r'}", "transitions=1920", *easy).returncode == 0
    before = numbers()
    said = here(*given, "transitions=3840").stdout
    assert "More training: transitions=N min_transitions=N" in said and numbers() == before
    assert here(*given, "min_transitions=960").returncode == 0
    assert numbers()[: len(before)] == before and len(numbers()) > len(before)
    before, spent = numbers(), int(json.loads((tmp_path / "r" / "summary.json").read_text())["transitions"])
    assert here(*given, f"transitions={spent}").returncode == 0  # nothing is collected ahead of the end
    assert here(*given, f"transitions={spent + 640}").returncode == 0 and numbers() == before
    assert here(*given, f"min_transitions={spent + 640}").returncode == 0 and len(numbers()) > len(before)


def test_widening_randomisation_resumes_with_the_same_numbers(tmp_path):
    words = "curriculum=doraemon", "curriculum.episodes=6", "curriculum.success=0.01", "collector=inline"
    whole, half = tmp_path / "whole", tmp_path / "half"
    for folder, much in ((whole, 1920), (half, 960)):
        done = here("pretrain", f"run_dir={folder}", f"transitions={much}", *words)
        assert done.returncode == 0, done.stderr
    assert here("pretrain", "--resume", str(half), "transitions=1920").returncode == 0
    ours, theirs = ([float(r["randomize_entropy"]) for r in rows(folder)] for folder in (whole, half))
    assert ours == theirs
    drawn = [json.loads((folder / "summary.json").read_text())["randomize"] for folder in (whole, half)]
    assert drawn[0] == drawn[1] and drawn[0]


def test_a_policy_with_a_memory_goes_on_after_a_stop_and_is_deployed_as_it_is(pretrained, tmp_path, capsys):
    words, whole = ["train=recurrent_dr", "train.agent.memory_dim=8", "collector=inline"], tmp_path / "whole"
    done = here("pretrain", f"run_dir={whole}", "transitions=640", f"checkpoint={pretrained}", *words)
    assert done.returncode == 0, done.stderr
    assert here("pretrain", "--resume", str(whole), "transitions=1280").returncode == 0
    assert [r["updates"] for r in rows(whole)][-1] == "64" and float(rows(whole)[-1]["q_loss"]) > 0
    found = checkpoint.load(whole / "checkpoint" / "model.safetensors").model
    given = [f"checkpoint={whole}", f"run_dir={tmp_path / 'd'}", "rollouts=1"]
    assert here("deploy", *given, "method=zero_shot", "planner=policy").returncode == 0
    after = checkpoint.load(tmp_path / "d" / "checkpoint" / "model.safetensors").model
    assert torch.equal(after.recurrent_policy.head[-1].weight, found.recurrent_policy.head[-1].weight)
    frozen, alone = "method=zero_shot", "planner=policy"  # sgft would train what does not act; a search ignores it
    pushed = [frozen, alone, "warmup=1", "exploration.offsets=[[0.1]]"]  # the policy prior
    for wrong in ([alone], [frozen], pushed):
        assert deploy.main(["--quiet", *TINY, *given[:1], f"run_dir={tmp_path / 'e'}", *wrong]) == 2
        assert "only planner=policy follows" in capsys.readouterr().err
    nothing, own = "which nothing trains any further", f"checkpoint={pretrained}"
    for i, (wrong, says) in enumerate(((given[:1], nothing), ([own, "imagined_steps=3"], "leaves as it is"))):
        assert pretrain.main(["--quiet", *TINY, *words, f"run_dir={tmp_path / str(i)}", *wrong]) == 2
        assert says in capsys.readouterr().err


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path):
    folder = tmp_path / "run"
    process = subprocess.Popen(
        command("pretrain", f"run_dir={folder}", "transitions=1000000"), stderr=subprocess.PIPE, text=True
    )
    wait_for(folder / "metrics.csv", process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"--resume {folder}" in err and (folder / "checkpoint" / "state.pt").exists()


def test_the_summary_holds_what_scripts_read(deployed):
    summary = json.loads((deployed / "summary.json").read_text())
    assert set(NEEDED) <= set(summary)
    assert summary["real_rollouts"] == 4 and summary["gap"] == "pendulum_torque"
    config = OmegaConf.load(deployed / "config.yaml")
    assert summary["updates"] == 4 * config.method.updates > 0
    parts = summary["seconds"]
    assert set(parts) == {"rollout", "learn", "evaluate"} and 0 < sum(parts.values()) < summary["wall_seconds"] + 0.2
    assert len(list((deployed / "episodes").glob("*.mcap"))) == 4
    told = {row["step"]: float(row["return"]) for row in rows(deployed) if row["return"]}
    returns = summary["return_curve"]
    assert (
        told and {step: returns[step] for step in told} == pytest.approx(told) and set(returns) == set(summary["curve"])
    )


def test_evaluation_episodes_follow_their_own_seed(pretrained, deployed, tmp_path):
    def before(*words: str) -> float:
        done = here(
            "deploy", f"checkpoint={pretrained}", "gap=pendulum_torque", "rollouts=1", "method.updates=0", *words
        )
        return json.loads(done.stdout.splitlines()[-1])["return_curve"]["0"]

    there = json.loads((deployed / "summary.json").read_text())["return_curve"]["0"]
    assert before(f"run_dir={tmp_path / 'same'}", "seed=5") == there
    assert before(f"run_dir={tmp_path / 'other'}", "seed=5", "eval_seed=${seed}") != there


def test_deployment_freezes_what_it_must(pretrained, deployed):
    before, after = (load_file(f / "checkpoint" / "model.safetensors") for f in (pretrained, deployed))
    free = ("dynamics.", "policy_head.")
    assert all((before[k] == after[k]).all() for k in before if not k.startswith(free))


def test_the_simulation_policy_drives_the_warm_up_and_the_planner_the_rest(pretrained, tmp_path):
    folder = tmp_path / "run"
    words = ["gap=pendulum_torque", "rollouts=2", "warmup=1", "method.action_noise=0", "method.updates=0"]
    done = here("deploy", f"checkpoint={pretrained}", f"run_dir={folder}", *words)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["real_rollouts"] == 2  # a warm-up rollout counts like any other
    model, _ = checkpoint.load(pretrained)
    for number, by_policy in ((1, True), (2, False)):
        episode = read_episode(folder / "episodes" / f"{number:04d}.mcap").transitions
        with torch.no_grad():
            wanted = model.policy_prior(model.encode(torch.as_tensor(episode["observation"]).float()), None)
        assert torch.allclose(wanted, torch.as_tensor(episode["action"]).float(), atol=1e-4) is by_policy


def test_the_first_rollout_does_not_wait_for_an_evaluation(pretrained, tmp_path, monkeypatch):
    """What was pretrained is measured after it was driven once, before it learns."""
    seen, evaluate = [], Deployment.evaluate

    def watched(self, *rest):
        seen.append((self.path(1).exists(), self.state["rollouts"], len(self.transfer.buffer)))
        evaluate(self, *rest)

    monkeypatch.setattr(Deployment, "evaluate", watched)
    given = [f"checkpoint={pretrained}", "gap=pendulum_torque", "method.updates=0"]
    assert here("deploy", *given, f"run_dir={tmp_path / 'one'}", "rollouts=1").returncode == 0
    assert here("deploy", *given, f"run_dir={tmp_path / 'none'}", "rollouts=0").returncode == 0
    assert [s[:2] for s in seen] == [(True, 0), (True, 1), (False, 0)] and seen[0][2] == 0
    curves = [json.loads((tmp_path / name / "summary.json").read_text())["return_curve"] for name in ("one", "none")]
    assert curves[0]["0"] == curves[1]["0"]


def test_a_warm_up_is_measured_by_the_model_that_drove_it(pretrained, tmp_path):
    words = ["gap=pendulum_torque", "rollouts=2", "warmup=2", "eval_every=2", "method.updates=25", "method.gate=false"]
    assert here("deploy", f"checkpoint={pretrained}", f"run_dir={tmp_path / 'r'}", *words).returncode == 0
    steps = from_episode(read_episode(tmp_path / "r" / "episodes" / "0002.mcap"), 2).steps
    wanted = open_loop_error(checkpoint.load(pretrained).model, steps, 4)[:, 0].nanmean()
    assert float(rows(tmp_path / "r")[1]["model_error_1"]) == pytest.approx(float(wanted), rel=1e-3)


def test_a_killed_deployment_loses_at_most_the_step_in_flight(pretrained, tmp_path):
    folder, words = tmp_path / "run", ["gap=pendulum_torque", "rollouts=3", "method.updates=2"]
    process = subprocess.Popen(command("deploy", f"checkpoint={pretrained}", f"run_dir={folder}", *words))
    second = folder / "episodes" / "0002.mcap"
    wait_for(second, process)
    deadline = time.monotonic() + 60
    while len(read_episode(second).transitions.get("step", ())) < 5 and time.monotonic() < deadline:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = len(read_episode(second).transitions["step"])
    assert kept >= 5
    state = checkpoint.load_state(folder / "checkpoint" / "state.pt")
    state["loop"]["spent"]["learn"] += 100
    checkpoint.save_state(folder / "checkpoint" / "state.pt", state)
    done = run("deploy", "--resume", str(folder))
    assert done.returncode == 0, done.stderr
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["real_rollouts"] == 3 and summary["aborted_rollouts"] <= 1
    assert summary["seconds"]["learn"] >= 100
    assert len(read_episode(second).transitions["step"]) == kept  # what happened is not driven again
    assert read_episode(folder / "episodes" / "0003.mcap").complete


class Killed(BaseException):
    """Nobody catches it."""


def test_a_rollout_is_drawn_once_although_the_process_died_learning_from_it(pretrained, tmp_path, monkeypatch):
    folder, learn, maps = tmp_path / "run", Transfer.learn, []

    def dies(self, *rest, **more):
        if self.verdicts:
            raise Killed
        return learn(self, *rest, **more)

    def watched(self, name, model):
        maps.append((name, copy.deepcopy(model.state_dict())))

    words = ["gap=pendulum_torque", "rollouts=3", "method.updates=2", "method.gate=false", "log.rerun=true"]
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Transfer, "learn", dies)
        here("deploy", f"checkpoint={pretrained}", f"run_dir={folder}", *words, "log.rerun_mb=0")
    assert checkpoint.load_state(folder / "checkpoint" / "state.pt")["loop"]["rollouts"] == 1
    monkeypatch.setattr(DeployViewer, "value_map", watched)
    assert here("deploy", "--resume", str(folder)).returncode == 0
    texts = [text for row in columns(folder / "run.rrd")["/episodes"]["TextLog:text"] for text in row]
    assert [text.partition(". ")[2] for text in texts] == ["rollout 1", "rollout 2", "rollout 3"]
    began = load_file(pretrained / "checkpoint" / "model.safetensors")
    (_, before), (_, after) = maps
    assert all((before[k] == x).all() for k, x in began.items()) and not all(
        (after[k] == x).all() for k, x in began.items()
    )


@pytest.mark.parametrize(
    ("words", "taken_over", "learned"),
    [([], 0, [True, True, False, False]), ([], 3, [True, True, False, True]), (["warmup=4"], 0, [True] * 4)],
    ids=["three wins", "one taken over", "wins of the simulation policy"],
)
def test_what_wins_stays_and_its_updates_are_counted(words, taken_over, learned, pretrained, tmp_path, monkeypatch):
    def wins(*args, number: int, **more):
        return drive(*args, number=number, **more)._replace(success=True, intervened=number == taken_over)

    monkeypatch.setattr("mpc_sgft.runs.deploy.drive", wins)
    words = ["gap=pendulum_torque", "rollouts=4", "method.updates=2", "method.win_stay=3", "quiet=false", *words]
    done = here("deploy", f"checkpoint={pretrained}", f"run_dir={tmp_path / 'run'}", *words)
    assert json.loads(done.stdout.splitlines()[-1])["updates"] == 2 * sum(learned)
    assert ("learning=paused" in done.stderr) is not learned[-1]
    assert [row["consistency_loss"] != "" for row in rows(tmp_path / "run") if row["step"] != "0"] == learned


def test_evaluations_of_different_seeds_share_no_round(pretrained, tmp_path, monkeypatch):
    seeds, collect = [], evaluating.collect

    def watched(*args, seed):
        seeds.append(seed)
        return collect(*args, seed=seed)

    monkeypatch.setattr(evaluating, "collect", watched)
    monkeypatch.setattr(evaluating, "CHUNK", 2)
    for seed in "012":
        words = [f"checkpoint={pretrained}", f"run_dir={tmp_path / seed}", f"seed={seed}", "episodes=6"]
        assert here("evaluate", *words).returncode == 0
    assert len(set(seeds)) == len(seeds) == 9


def test_evaluate_reports_an_interval(pretrained, tmp_path):
    done = here("evaluate", f"checkpoint={pretrained}", f"run_dir={tmp_path / 'e'}", "episodes=6")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    low, high = result["success_interval"]
    assert result["episodes"] == 6 and low <= result["success"] <= high


def test_the_scripted_pendulum_swings_up(tmp_path):
    done = here("evaluate", "policy=scripted", f"run_dir={tmp_path / 'e'}", "episodes=40", "quiet=false")
    assert "evaluate: 100%" in done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["success"] >= 0.95


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["backend=franka"], "task=pendulum cannot run on the robot"),
        (["checkpoint=nowhere"], "nowhere"),
        (["task=push"], "task"),
        (["gap.effects.actuator_gain.gain=99"], "-5"),
        (["gap.effects.actuator_gain.gian=0.5"], "gain"),
        (["method.win_stay=null"], "win_stay=None must be 0 or more"),
        (["method.slice_len=41"], "method.slice_len=41: an episode of 40 steps holds no such slice"),
        (["planner.num_elites=100000"], "num_elites"),
        (["model=5M"], "latent_dim"),
        (["train=recurrent_dr"], "train=recurrent_dr begins a policy anew"),
    ],
)
def test_bad_input_is_one_clear_line(pretrained, tmp_path, capsys, words, says):
    given = words if any(w.startswith("checkpoint") for w in words) else [f"checkpoint={pretrained}", *words]
    assert deploy.main(["--quiet", *TINY, f"run_dir={tmp_path / 'r'}", *given]) == 2
    err = capsys.readouterr().err
    assert says in err and "Traceback" not in err


def test_what_a_resumed_run_refuses_leaves_it_as_it_was(pretrained, deployed, tmp_path):
    for name, run, wrong in (
        ("deploy", deployed, "rollouts=1"),
        ("deploy", deployed, "planner.num_elites=100000"),
        ("pretrain", pretrained, "collector.workers=99"),
    ):
        folder = shutil.copytree(run, tmp_path / wrong)
        done = here(name, "--resume", str(folder), wrong)
        assert done.returncode == 2 and wrong.rpartition(".")[2] in done.stderr, done.stderr
        for kept in ("config.yaml", "summary.json"):
            assert (folder / kept).read_bytes() == (run / kept).read_bytes()


def test_a_checkpoint_that_changed_since_is_said_before_anything_is_driven(pretrained, deployed, tmp_path):
    began, folder = shutil.copytree(pretrained, tmp_path / "began"), shutil.copytree(deployed, tmp_path / "r")
    cfg = OmegaConf.load(folder / "config.yaml")
    cfg.checkpoint = str(began)
    OmegaConf.save(cfg, folder / "config.yaml")
    path = began / "checkpoint" / "model.safetensors"
    model, meta = checkpoint.load(path)
    next(model.encoder.parameters()).data += 0.01
    checkpoint.save(path, model, meta)
    done = here("deploy", "--resume", str(folder), "rollouts=5")
    assert done.returncode == 2 and "is not the one that the run began with" in done.stderr, done.stderr
    assert not (folder / "episodes" / "0005.mcap").exists()


def test_a_corrupt_checkpoint_is_named(pretrained, tmp_path, capsys):
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes((pretrained / "checkpoint" / "model.safetensors").read_bytes()[:-100])
    assert deploy.main(["--quiet", *TINY, f"checkpoint={bad}", f"run_dir={tmp_path / 'r'}"]) == 2
    err = capsys.readouterr().err
    assert "bad.safetensors" in err and "Traceback" not in err


def wait_for(path: Path, process: subprocess.Popen, seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not path.exists():
        assert process.poll() is None, f"ended with {process.returncode} before {path.name} appeared"
        assert time.monotonic() < deadline, f"{path} did not appear in {seconds} s"
        time.sleep(0.01)


def test_relearning_a_deployment_as_it_was_gives_what_it_learned(deployed):
    cfg = relearn.config_of(deployed, [], seed=OmegaConf.load(deployed / "config.yaml").seed)
    learned, success = relearn.relearn(cfg, relearn.rollouts_of(deployed), at=[4])
    assert success == {4: json.loads((deployed / "summary.json").read_text())["final_success"]}
    then = load_file(deployed / "checkpoint" / "model.safetensors")
    now = learned.acting.state_dict()
    assert then.keys() == now.keys() and all((then[k] == now[k]).all() for k in then)


def test_relearning_takes_other_settings_and_refuses_unknown_ones(deployed, pretrained):
    changed = relearn.config_of(deployed, ["method.updates=7"], seed=1).method
    assert changed.updates == 7 and changed.win_stay == 0, "others have won"
    assert relearn.config_of(deployed, ["method.win_stay=3"], seed=1).method.win_stay == 3
    assert relearn.config_of(deployed, [], seed=1).method.win_stay == 5
    with pytest.raises(UserError, match="updats"):
        relearn.config_of(deployed, ["method.updats=7"], seed=1)
    with pytest.raises(UserError, match="no deployment"):
        relearn.config_of(pretrained, [], seed=1)
    with pytest.raises(UserError, match="simulated gap"):
        relearn.config_of(deployed, ["backend.name=franka"], seed=1)
