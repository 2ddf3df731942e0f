"""What `deploy --resume` says of files that a power loss left damaged: only weights and state are forced to disk."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from mpc_sgft import deploy as front
from mpc_sgft.runs import deploy
from tests.mpc_sgft.session.test_verdicts import broken_at, rows, run


class Dead(BaseException):
    """Nobody catches it."""


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> Path:
    """A run that died when the first of its two rollouts was learned from."""
    folder = tmp_path_factory.mktemp("runs") / "stopped"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Dead):
        patch.setattr(deploy, "drive", broken_at(2, Dead))
        run(folder, None, "rollouts=2", "log.rerun=true")
    return folder


def zeros(path: Path) -> None:
    path.write_bytes(bytes(5000))


def hole(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(4000) + data[len(data) // 2 + 4000 :])


@pytest.mark.parametrize(
    ("name", "damage"),
    [("run.rrd", zeros), ("run.rrd", hole), ("episodes/0002.mcap", zeros), ("metrics.csv", zeros)],
)
def test_a_damaged_file_is_named_and_moved_away_it_is_in_nobodys_way(
    name: str, damage: Callable[[Path], None], stopped: Path, tmp_path: Path, capsys
) -> None:
    folder = shutil.copytree(stopped, tmp_path / "r")
    damage(folder / name)
    left = (folder / name).read_bytes()
    assert front.main(["--resume", str(folder), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {folder / name} is ") and "Move it away" in said and said.count("\n") == 1, said
    assert (folder / name).read_bytes() == left and not (folder / "summary.json").exists()
    (folder / name).rename(tmp_path / "away")
    assert front.main(["--resume", str(folder), "--quiet"]) == 0


def test_rows_that_were_cut_short_are_left_out_and_counted(stopped: Path, tmp_path: Path, capsys) -> None:
    folder = shutil.copytree(stopped, tmp_path / "r")
    path = folder / "metrics.csv"
    path.write_bytes(path.read_bytes() + b"1,0.5\n" + bytes(100) + b"\n")
    assert front.main(["--resume", str(folder), "--quiet"]) == 0
    assert f"{path}: 2 damaged rows are left out" in capsys.readouterr().err
    assert [row["step"] for row in rows(folder, "metrics.csv")] == ["1", "2"]
