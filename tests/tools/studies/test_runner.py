"""Many runs, one row each: what is done is skipped, what was cut off goes on."""

import json
from pathlib import Path

import pytest

from tools.studies.runner import RunFailed, each, finished, first_mean, measured

TINY = ["+experiment=debug", "task=pendulum", "transitions=640", "log.tensorboard=false"]


def test_a_run_is_made_once_and_resumed_if_cut_off(tmp_path):
    run = tmp_path / "run"
    summary = finished("pretrain", run, TINY)
    assert summary["transitions"] == 640
    stamp = (run / "checkpoint" / "state.pt").stat().st_mtime_ns
    (run / "summary.json").write_text(json.dumps({"known": True}))
    assert finished("pretrain", run, TINY) == {"known": True}  # it is there: nothing runs
    (run / "summary.json").write_text('{"known')
    with pytest.raises(RunFailed, match="summary.json cannot be read"):
        finished("pretrain", run, TINY)
    (run / "summary.json").unlink()
    with pytest.raises(RunFailed, match="made with pretrain .* asked for is pretrain seed=99"):
        finished("pretrain", run, ["seed=99"])
    assert finished("pretrain", run, TINY)["seed"] == 0  # resumed
    assert (run / "summary.json").is_file()
    assert (run / "checkpoint" / "state.pt").stat().st_mtime_ns == stamp  # nothing is trained again


def test_a_launcher_starts_a_run_elsewhere(tmp_path):
    """submitit's own local executor: a process of its own, as on a cluster that runs SLURM."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs submitit")
    run, launcher, minutes = tmp_path / "run", "submitit_local", "hydra.launcher.timeout_min=4"
    learns = ["gap=turned", "rollouts=1", "eval_episodes=2", "log.rerun=false", minutes]
    assert finished("deploy", run, learns, launcher)["updates"] > 0
    assert list((tmp_path / "run.sweep" / ".submitit").glob("*/*_log.out"))
    words = ["policy=scripted", "episodes=2", minutes]
    with pytest.raises(RunFailed, match="error: No checkpoint at /nowhere"):
        finished("evaluate", tmp_path / "bad", ["checkpoint=/nowhere/at/all", "episodes=2"], launcher)
    (tmp_path / "begun.asked").write_text("evaluate\npolicy=scripted\nepisodes=2\n")
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "config.yaml").touch()
    with pytest.raises(RunFailed, match="begun and not finished"):
        finished("evaluate", tmp_path / "begun", words, launcher)


def test_runs_are_jobs_on_a_ray_cluster(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_ray_launcher", reason="needs Ray's launcher")
    few = "+hydra.launcher.ray.init.num_cpus=1"
    found = finished("evaluate", tmp_path / "run", ["task=pendulum", "policy=scripted", "episodes=2", few], "ray")
    assert found["episodes"] == 2 and (tmp_path / "run.asked").read_text().count("hydra") == 0
    with pytest.raises(RunFailed, match="No checkpoint at /nowhere"):
        finished("evaluate", tmp_path / "bad", ["checkpoint=/nowhere/at/all", "episodes=2", few], "ray")


def test_a_failure_is_told_and_the_others_go_on(tmp_path, capsys):
    def work(name):
        if name == "bad":
            finished("pretrain", tmp_path / name, ["tsak=push"])
        return {"name": name}

    assert each(["a", "bad", "b"], work, 2) == ([{"name": "a"}, {"name": "b"}], 1)
    assert "tsak" in capsys.readouterr().err
    with pytest.raises(RunFailed, match="exit code 2"):
        work("bad")
    with pytest.raises(RunFailed, match="unknown task 'pusch'"):  # nothing was made: other words may be tried there
        finished("pretrain", tmp_path / "bad", ["task=pusch"])


def test_rows_are_on_disk_as_they_come_and_not_measured_twice(tmp_path):
    path, asked = tmp_path / "new" / "out.csv", []

    def work(gap, horizon):
        asked.append((gap, horizon))
        if gap == "c" and len(asked) == 2:
            raise KeyboardInterrupt
        return {"gap": gap, "horizon": horizon, "success": 0.5}

    keys = [{"gap": "a", "horizon": 4}, {"gap": "c", "horizon": 4}]
    with pytest.raises(KeyboardInterrupt):
        measured(path, ["gap", "horizon", "success"], keys, work)
    assert path.read_text() == "gap,horizon,success\na,4,0.5\n"
    measured(path, ["gap", "horizon", "success"], keys, work)
    assert asked == [("a", 4), ("c", 4), ("c", 4)] and len(path.read_text().splitlines()) == 3
    with pytest.raises(ValueError, match="other"):
        measured(path, ["gap", "other"], keys, work)
    assert Path(path).read_text().startswith("gap,horizon,success")


def test_the_mean_of_a_columns_first_rows(tmp_path):
    (tmp_path / "metrics.csv").write_text("step,share,other\n1,0.5,\n2,,\n3,0.25,\n4,0.9,\n")
    assert first_mean(tmp_path, "share", 3) == pytest.approx(0.375)  # the gap is left out
    assert first_mean(tmp_path, "other", 3) is None and first_mean(tmp_path, "absent", 3) is None
