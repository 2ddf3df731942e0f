"""Deployments that were diagnosed and made again become rows of the study and curves of the benchmark."""

import csv
import json
from pathlib import Path

import pytest
import torch

from mpc_sgft.command.compose import compose
from mpc_sgft.runs.exploration import Exploration
from tools.studies import close_the_loop
from tools.studies.runner import RunFailed, read_curves

HOW = ["--retrain", "--retrain-transitions", "60000"]


def asked(folder: Path, *words: str) -> None:
    """What a study notes beside a folder that it makes."""
    folder.with_name(f"{folder.name}.asked").write_text("\n".join(words))


def deployment(folder: Path, zero_shot: float, seed: int = 0) -> None:
    folder.mkdir(parents=True)
    asked(folder, "deploy", "gap=turned", f"seed={seed}", "log.rerun=false")
    curves = {"curve": {"0": zero_shot, "10": zero_shot}, "return_curve": {"0": -1.0, "10": -1.0}}
    summary = {"real_rollouts": 10, "evaluation_episodes": 100, **curves}
    (folder / "summary.json").write_text(json.dumps(summary))


def test_what_was_measured_is_written_and_nothing_runs_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    angle = {"name": "frame_rotation", "at": ["base"], "parameters": {"angle": {"value": 0.6}}}
    for seed, effects in ((0, [angle]), (1, [])):
        run = tmp_path / "runs" / f"turned-{seed}"
        deployment(run, 0.1, seed)
        (run / "diagnosis").mkdir()
        asked(run / "diagnosis", *HOW)
        report = {"verdict": "effect" if effects else "none", "effects": effects, "seconds": 80.0}
        (run / "diagnosis" / "report.json").write_text(json.dumps(report))
        if effects:
            deployment(run / "diagnosis" / "deploy", 0.9)
            outcome = {"zero_shot_success": 0.9, "final_success": 0.95, "rollouts_to_95": 10}
            both = {"transitions": 60000, "before": outcome | {"zero_shot_success": 0.1}, "after": outcome}
            (run / "diagnosis" / "retrain.json").write_text(json.dumps(both))
    words = ["loop", str(tmp_path / "loop.csv"), "--gaps", "turned", "--seeds", "0", "1", "--runs", f"{tmp_path}/runs"]
    monkeypatch.setattr("sys.argv", [*words, "--curves", str(tmp_path / "curves.csv")])
    close_the_loop.main()
    monkeypatch.setattr("sys.argv", [*words, "--effects", "payload"])
    with pytest.raises(RunFailed, match="diagnosis was made with --retrain .* asked for is .* --effects payload"):
        close_the_loop.main()  # else the old verdict would pass for that of another question
    first, second = csv.DictReader((tmp_path / "loop.csv").open())
    assert (first["found"], first["zero_shot_after"]) == ("frame_rotation@base angle=0.6", "0.9")
    assert (second["verdict"], second["found"], second["zero_shot_after"]) == ("none", "", "")
    seeds = read_curves([tmp_path / "curves.csv"])["turned"]["identify"]
    successes = {seed: [curve[n]["success"] for n in (0, 10)] for seed, curve in seeds.items()}
    assert successes == {0: ["0.1", "0.9"], 1: ["0.1", "0.1"]}  # who names nothing trains nothing again


@pytest.mark.parametrize(("method", "more"), [("dropo", []), ("asid", ["--explore"])])
def test_ranges_are_a_method_of_their_own_beside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, more: list[str]
) -> None:
    run = tmp_path / "runs" / f"{'asid-' * len(more)}turned-0"
    deployment(run, 0.1)
    (run / "config.yaml").touch()
    deployment(run / "ranges" / "deploy", 0.7)
    asked(run / "ranges", *HOW, "--ranges", "push")
    outcome = {"zero_shot_success": 0.7, "final_success": 0.7, "rollouts_to_95": None}
    both = {"transitions": 60000, "before": outcome | {"zero_shot_success": 0.1}, "after": outcome}
    (run / "ranges" / "retrain.json").write_text(json.dumps(both))
    (run / "ranges" / "ranges.yaml").write_text("draws: {mass: {low: 1.5, high: 1.7}}")
    words = ["loop", str(tmp_path / "loop.csv"), "--gaps", "turned", "--seeds", "0", "--runs", f"{tmp_path}/runs"]
    monkeypatch.setattr("sys.argv", [*words, *more, "--ranges", "push", "--curves", str(tmp_path / "curves.csv")])
    close_the_loop.main()
    (row,) = csv.DictReader((tmp_path / "loop.csv").open())
    assert (row["verdict"], row["found"], row["zero_shot_after"]) == ("ranges", "mass 1.5 to 1.7", "0.7")
    seeds = read_curves([tmp_path / "curves.csv"])["turned"]
    assert set(seeds) == {f"{method} ranges=push"}


def test_who_explores_drives_every_rollout_so(monkeypatch: pytest.MonkeyPatch) -> None:
    found = Exploration(0.5, torch.tensor([[0.25, -1.0]]), torch.ones(4), torch.ones(4))
    monkeypatch.setattr(close_the_loop, "explore", lambda cfg, model, seed: found)
    words = close_the_loop.exploring(3, "push", ["gap=turned", "rollouts=7"])
    made = compose("deploy", ["rollouts=7", *words], [])
    assert made.warmup == 7 and made.exploration == {"weight": 0.5, "offsets": [[0.25, -1.0]]}
