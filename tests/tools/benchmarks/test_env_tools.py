"""The tools that measure the world run, and say what they found."""

import csv
import itertools
import json

import pytest

from tools.benchmarks import benchmark_env
from tools.studies import check_stability


def test_stability_counts_episodes(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert check_stability.main(["--task", "pendulum", "--episodes", "64", "--out", "found.json"]) == 0
    said, found = capsys.readouterr().out, json.loads((tmp_path / "found.json").read_text())
    assert (found["episodes"], found["control_steps"], found["unstable"]) == (64, 2560, 0)
    assert "pendulum: 64 random episodes, 2560 control steps" in said and "unstable: 0;" in said


def test_stability_fails_when_the_physics_does(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    make = check_stability.make_env

    def fragile(*args, **kwargs):
        env = make(*args, **kwargs)
        monkeypatch.setattr(env.task, "start", _far(env.task.start))
        return env

    monkeypatch.setattr(check_stability, "make_env", fragile)
    assert check_stability.main(["--task", "pendulum", "--episodes", "1"]) == 1
    assert "unstable: 64;" in capsys.readouterr().out


def _far(start):
    return lambda rng: start(rng)._replace(qvel=start(rng).qvel + 1e12)


@pytest.mark.slow
def test_benchmark_writes_its_table(capsys, tmp_path) -> None:
    out = tmp_path / "new" / "benchmark.csv"
    benchmark_env.main(["--tasks", "push", "walker_walk", "--repeats", "1", "--out", str(out)])
    with open(out, newline="") as file:
        rows = {(row["task"], row["what"]): row for row in csv.DictReader(file)}
    assert set(rows) == set(itertools.product(("push", "walker_walk"), ("control_env", "raw_mj_step")))
    env, raw = rows["push", "control_env"], rows["push", "raw_mj_step"]
    assert float(env["control_env_over_this"]) == 1.0 and env["cpu"]
    assert 0.3 < float(raw["control_env_over_this"]) < 3
