"""Two commits are timed in turn, each with its own code, and leave no checkout behind."""

import csv
import shutil
import subprocess
from pathlib import Path

import pytest

from tools.benchmarks import time_commits

PARTS = ("configs", "envs", "mpc_sgft", "planners", "tools")  # what a checkout is asked for
WHO = ("-c", "user.name=test", "-c", "user.email=test@example.org")


@pytest.fixture
def git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A repository of its own with this code; runs git there and gives what it prints."""
    root = tmp_path / "repository"
    for part in PARTS:
        shutil.copytree(time_commits.ROOT / part, root / part, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(time_commits, "ROOT", root)

    def run(*words: str) -> str:
        line = ["git", "-C", str(root), *WHO, *words]
        return subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip()

    run("init", "--quiet")
    return run


def commit(git, subject: str) -> str:
    git("add", "--all", "--force")
    git("commit", "--quiet", "--no-verify", "-m", subject)
    return git("rev-parse", "--short=7", "HEAD")


def test_each_commit_is_timed_with_its_own_numbers(git, tmp_path):
    before = commit(git, "A plan of four iterations")
    planner = time_commits.ROOT / "configs" / "planner" / "mppi.yaml"
    planner.write_text(planner.read_text().replace("iterations: 4 ", "iterations: 200 "))
    method = time_commits.ROOT / "configs" / "method" / "sgft.yaml"
    method.write_text(method.read_text().replace("observation_map: true", "observation_map: false"))
    after = commit(git, "A plan of two hundred")
    there, out = git("worktree", "list"), tmp_path / "out.csv"
    words = ["--what", "plan", "update", "adapt", "--sizes", "small", "--precisions", "float32"]
    words += ["--rounds", "1", "--out", str(out)]
    assert time_commits.main([before, *words]) == 0
    with out.open(newline="") as file:
        plan, update, adapt = csv.DictReader(file)
    assert (plan["what"], update["what"], adapt["what"]) == ("plan", "update", "adapt")
    assert {(row["before"], row["after"]) for row in (plan, update, adapt)} == {(before, after)}
    assert float(plan["ratio"]) > 3  # about forty on a quiet machine
    assert float(adapt["before_ms"]) > 0 and float(adapt["after_ms"]) > 0
    assert float(plan["ratio"]) == pytest.approx(float(plan["after_ms"]) / float(plan["before_ms"]), rel=0.1)
    assert git("worktree", "list") == there


def test_what_is_no_commit_is_named(git):
    commit(git, "Begin")
    with pytest.raises(SystemExit, match="nowhere: no commit of this repository"):
        time_commits.main(["nowhere"])


def test_a_commit_that_cannot_be_timed_is_told(git, tmp_path, capfd):
    (time_commits.ROOT / "planners" / "malloc.py").unlink()
    before = commit(git, "Too early")
    with pytest.raises(SystemExit, match="ended before it was timed, for the reason above"):
        time_commits.main([before, "--sizes", "small", "--rounds", "1", "--out", str(tmp_path / "out.csv")])
    assert "planners.malloc" in capfd.readouterr().err
