"""Run folders, and how runs are resumed, as a user meets them at the front of the commands."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from mpc_sgft.command import cli, compose, resumed
from mpc_sgft.command.errors import UserError
from mpc_sgft.storage import run_folder
from tests.probes import probe


def test_run_folder_holds_config_and_versions_and_is_the_latest(loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), ["task=pendulum", "seed=5"]) == 0
    folder = Path(capsys.readouterr().out.strip())
    assert folder.parent == loops / "runs" / "pendulum"
    saved = yaml.safe_load((folder / "config.yaml").read_text())
    assert (saved["seed"], saved["chosen"]["task"], saved["command"]) == (5, "pendulum", "deploy")
    versions = json.loads((folder / "versions.json").read_text())
    assert versions["torch"] and versions["mujoco"] and versions["cpu"]
    assert (loops / "runs" / "latest").resolve() == (loops / "runs" / "pendulum" / "latest").resolve() == folder


def test_runs_of_the_same_second_get_folders_of_their_own(loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), []) == cli.run(probe("folder"), []) == 0
    first, second = capsys.readouterr().out.split()
    assert first != second
    assert (loops / "runs" / "latest").resolve() == Path(second)


def test_a_folder_with_files_is_left_untouched(loops: Path, capsys) -> None:
    (loops / "mine").mkdir()
    (loops / "mine" / "summary.json").write_text("{}")
    assert cli.run(probe("folder"), ["run_dir=mine"]) == 2
    assert "already holds files" in capsys.readouterr().err
    assert [p.name for p in (loops / "mine").iterdir()] == ["summary.json"]


def test_a_run_dir_below_a_file_is_refused(loops: Path, capsys) -> None:
    (loops / "file").write_text("")
    assert cli.run(probe("folder"), ["run_dir=file/run"]) == 2
    assert "Choose another place with run_dir=" in capsys.readouterr().err


def test_resume_takes_the_saved_config_and_its_folder(loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), ["run_dir=first", "seed=7", "horizon=2"]) == 0
    assert cli.run(probe("show"), ["--resume", "first"]) == 0
    assert cli.run(probe("folder"), ["--resume", "first"]) == 0
    assert capsys.readouterr().out.split("\n")[1:3] == ["7 none 2", str(loops / "first")]
    assert cli.run(probe("folder"), ["--resume", "first", "horizon=3"]) == 0
    assert cli.run(probe("show"), ["--resume", "first"]) == 0  # what it was told holds from then on
    assert capsys.readouterr().out.split("\n")[1] == "7 none 3"
    assert cli.run(probe("folder"), ["run_dir=whole", "planner.temperature=1"]) == 0  # may have a fraction all the same
    assert cli.run(probe("show"), ["--resume", "whole", "planner.temperature=0.5"]) == 0
    assert cli.run(probe("show"), ["--resume", "whole", "rollouts=${nowhere}"]) == 2
    assert "cannot be resolved" in capsys.readouterr().err


def test_what_a_resumed_run_is_told_does_not_fit_on_the_disk(loops: Path, monkeypatch, capsys) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    assert cli.run(probe("folder"), ["run_dir=first"]) == 0
    monkeypatch.setattr(run_folder, "write_whole", full)
    assert cli.run(probe("folder"), ["--resume", "first", "horizon=3"]) == 2
    said = capsys.readouterr().err
    assert "first/config.yaml: the disk is full" in said and "the same --resume goes on" in said


def test_a_resumed_run_changes_what_is_given_as_another_setting_too(loops: Path) -> None:
    def horizons(folder: str, *words: str) -> tuple[int, int]:
        cfg = resumed.resume("deploy", folder, [compose.normalise(word) for word in words], words)
        return cfg.planner.horizon, cfg.method.horizon

    assert cli.run(probe("folder"), ["run_dir=first", "horizon=4"]) == 0
    assert horizons("first", "horizon=8") == (8, 8)
    assert horizons("first", "method.horizon=4", "horizon=8") == horizons("first", "horizon=8", "method.horizon=4")
    assert horizons("first", "horizon=8", "method.horizon=4") == (8, 4)
    assert cli.run(probe("folder"), ["run_dir=own", "horizon=4", "method.horizon=3"]) == 0
    assert horizons("own", "horizon=8") == (8, 3)


@pytest.mark.parametrize(
    "change",
    ["task=pendulum", "seed=1", "gap.effects.payload.mass=1", "run_dir=other", "model.mlp_dim=16", "method.lr=1e-5"]
    + ["method.residual=true", "method.command_band=false", "method.suspicion_margin=0"]
    + ["method.slice_len=8", "method.gate_excess=0"],
)
def test_resume_refuses_to_become_another_run(change: str, loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), ["run_dir=first"]) == 0
    assert cli.run(probe("show"), ["--resume", "first", change]) == 2
    assert "cannot change in a resumed run" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["device=gpu", "success=aks"])
def test_resume_refuses_words_that_do_not_exist(change: str, loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), ["run_dir=first"]) == 0
    assert cli.run(probe("show"), ["--resume", "first", change]) == 2
    assert "unknown {} '{}'".format(*change.split("=")) in capsys.readouterr().err


@pytest.mark.parametrize("content", [bytes(3000), b"\xff\xfe", b"seed: [1"])
def test_a_config_that_is_damaged_is_one_line(content: bytes, loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), ["run_dir=first"]) == 0
    (loops / "first" / "config.yaml").write_bytes(content)
    assert cli.run(probe("folder"), ["--resume", "first"]) == 2
    said = capsys.readouterr().err
    assert "cannot resume first: its config.yaml is damaged (" in said and said.count("\n") == 1


def test_resume_refuses_the_run_of_another_command(loops: Path, capsys) -> None:
    assert cli.run(probe("folder"), ["run_dir=first"]) == 0
    assert cli.run(probe("show", name="evaluate"), ["--resume", "first"]) == 2
    assert "deploy wrote it" in capsys.readouterr().err


def test_a_linked_checkpoint_is_followed_before_the_link_moves(loops: Path) -> None:
    (loops / "old").mkdir()
    (loops / "latest").symlink_to("old")
    cfg = compose.compose("deploy", [compose.normalise("checkpoint=latest")], [])
    assert cfg.checkpoint == str(loops / "old")


def test_latest_that_is_no_link_is_not_replaced(loops: Path) -> None:
    (loops / "runs" / "latest").mkdir(parents=True)
    with pytest.raises(UserError, match="not a link"):
        run_folder.start(compose.compose("deploy", [], []))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda cfg: cfg.pop("collector"), "it had no collector"),
        (lambda cfg: cfg.pop("physics"), "it had no physics"),
        (lambda cfg: cfg.train.agent.pop("td_lambda"), "it had no train.agent.td_lambda"),
        (lambda cfg: cfg.planner.update(temperature=2.0), "its planner.temperature was in reward units"),
        (
            lambda cfg: cfg.collector.update({"_target_": "mpc_sgft.gone.Process"}),
            "gone.Process has moved since",
        ),
        (lambda cfg: None, None),
        (lambda cfg: (cfg.overrides.append("~train.agent.td_lambda"), cfg.train.agent.pop("td_lambda")), None),
        (lambda cfg: cfg.gap.effects.update({"actuator_gain": {"gain": 0.9}}), None),
    ],
)
def test_a_run_of_an_earlier_version_is_refused_by_name(tmp_path, change, says):
    cfg = compose.compose("pretrain", ["task=push"], [])
    OmegaConf.set_struct(cfg, False)
    change(cfg)
    (tmp_path / "config.yaml").write_text(OmegaConf.to_yaml(cfg, resolve=True))
    if says is None:
        assert resumed.resume("pretrain", str(tmp_path), [], []).resume == str(tmp_path)
        return
    with pytest.raises(UserError, match=f"an earlier version wrote it .*{says}.*versions.json"):
        resumed.resume("pretrain", str(tmp_path), [], [])
