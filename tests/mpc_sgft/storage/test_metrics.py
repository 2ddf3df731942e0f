import csv
import io
import math
import resource
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.metrics import GrowingTable, MetricLogger, progress


def rows(run_dir) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows_are_on_disk_at_once_and_exact(tmp_path):
    logger = MetricLogger(tmp_path, tensorboard=False)
    logger.log(0, {"loss": 0.1, "success": np.float32(0.5), "flag": True, "count": torch.tensor([3])})
    assert rows(tmp_path) == [{"step": "0", "loss": "0.1", "success": "0.5", "flag": "1", "count": "3"}]
    logger.log(10, {"loss": 1 / 3, "count": float("nan")})
    assert float(rows(tmp_path)[1]["loss"]) == 1 / 3
    assert rows(tmp_path)[1]["success"] == "" and math.isnan(float(rows(tmp_path)[1]["count"]))


def test_a_new_key_adds_a_column_and_keeps_every_row(tmp_path):
    with MetricLogger(tmp_path, tensorboard=False) as logger:
        for step in range(5):
            logger.log(step, {"loss": step})
        logger.log(5, {"success": 1.0, "loss": 5})
        logger.log(6, {"loss": 6})
    assert (tmp_path / "metrics.csv").read_text().splitlines()[0] == "step,loss,success"
    assert [row["loss"] for row in rows(tmp_path)] == list("0123456")
    assert [row["success"] for row in rows(tmp_path)] == ["", "", "", "", "", "1.0", ""]
    assert list(tmp_path.iterdir()) == [tmp_path / "metrics.csv"]


def test_resume_continues_as_if_never_interrupted(tmp_path):
    with MetricLogger(tmp_path, tensorboard=False) as logger:
        for step in range(6):
            logger.log(step, {"loss": step, "extra": 2 * step})
    whole = (tmp_path / "metrics.csv").read_text()
    path = tmp_path / "metrics.csv"
    path.write_text(whole + "6,6")  # torn by a kill
    with MetricLogger(tmp_path, tensorboard=False, resume_step=3) as logger:
        assert [row["step"] for row in rows(tmp_path)] == list("0123")
        for step in (4, 5):
            logger.log(step, {"extra": 2 * step, "loss": step})
    assert path.read_text() == whole


@pytest.mark.parametrize("content", [bytes(50), b"step,loss\n0," + bytes(200_000) + b"\n", b"\x89PNG"])
def test_what_cannot_be_a_table_is_named_and_kept(tmp_path, content):
    (tmp_path / "metrics.csv").write_bytes(content)
    with pytest.raises(UserError, match="metrics.csv is .*Move it away"):
        MetricLogger(tmp_path, tensorboard=False, resume_step=3)
    assert (tmp_path / "metrics.csv").read_bytes() == content


def test_damaged_rows_are_left_out(tmp_path, capsys):
    (tmp_path / "metrics.csv").write_bytes(b"step,loss\n0,1.5\n1\n\0\0,2\n\xff,2\n2,0.5\n")
    MetricLogger(tmp_path, tensorboard=False, resume_step=3).close()
    assert [row["step"] for row in rows(tmp_path)] == ["0", "2"]
    assert "metrics.csv: 3 damaged rows are left out" in capsys.readouterr().err


def test_a_new_run_does_not_overwrite(tmp_path):
    MetricLogger(tmp_path, tensorboard=False).close()
    with pytest.raises(FileExistsError, match="metrics.csv"):
        MetricLogger(tmp_path, tensorboard=False)


def test_values_that_are_no_scalars_are_named(tmp_path):
    with MetricLogger(tmp_path, tensorboard=False) as logger:
        for value in (np.zeros(2), "good", None):
            with pytest.raises(ValueError, match="'loss'"):
                logger.log(0, {"loss": value})
        with pytest.raises(ValueError, match="step"):
            logger.log(0, {"step": 1})


@contextmanager
def full_at(size: int):
    """No file may grow beyond so many bytes, which is what a full disk is to a writer."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)


@pytest.mark.parametrize("name", ["loss", "another"])
def test_a_full_disk_names_the_file(tmp_path, name):
    logger = MetricLogger(tmp_path, tensorboard=False)
    logger.log(0, {"loss": 0})
    with full_at(100), pytest.raises(OSError, match="metrics.csv'"):
        for step in range(100):
            logger.log(step, {name if step > 10 else "loss": 0})
    assert [row["step"] for row in rows(tmp_path)][:11] == ["0", *map(str, range(10))]
    with full_at(5), pytest.raises(OSError, match="metrics.csv'"):
        MetricLogger(tmp_path, tensorboard=False, resume_step=9)
    assert list(tmp_path.iterdir()) == [tmp_path / "metrics.csv"]


def test_a_full_disk_names_the_files_of_tensorboard(tmp_path, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda _: None)  # TensorBoard's own thread ends with it, too
    others = threading.enumerate()
    logger = MetricLogger(tmp_path, csv=False)
    (events,), (worker,) = (tmp_path / "tensorboard").iterdir(), set(threading.enumerate()).difference(others)
    with full_at(events.stat().st_size + 20), pytest.raises(OSError, match="tensorboard'"):
        for step in range(100):
            logger.log(step, {"loss": 0})
    worker.join(10)


def test_tensorboard_has_the_same_numbers(tmp_path):
    with MetricLogger(tmp_path, csv=False) as logger:
        logger.log(0, {"loss": 2.0})
        logger.log(7, {"loss": 1.0})
    assert not (tmp_path / "metrics.csv").exists()
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert [(event.step, event.value) for event in board.Scalars("loss")] == [(0, 2.0), (7, 1.0)]


def test_wandb_missing_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ModuleNotFoundError, match="pip install"):
        MetricLogger(tmp_path, tensorboard=False, wandb=True)


def test_wandb_gets_the_same_rows(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="needs wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    with MetricLogger(tmp_path, csv=False, tensorboard=False, wandb=True, resume_step=4) as logger:
        logger.log(5, {"loss": 0.5})
        logger.log(7, {"loss": 0.25})
        assert (wandb.run.step, wandb.run.summary["loss"]) == (7, 0.5)  # a row is whole when the next step begins
    (stored,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    assert stored.stat().st_size > 0 and wandb.run is None


def test_progress_shows_count_time_left_and_numbers(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    bar = progress(100, initial=40, desc="pretrain")
    bar.mininterval = 0
    bar.update(10)
    bar.set_postfix(success="97%")
    bar.close()
    text = screen.getvalue()
    assert "pretrain" in text and "50/100" in text and "<" in text and "success=97%" in text


def test_table_prints_the_header_once_and_columns_line_up():
    screen = io.StringIO()
    table = GrowingTable(file=screen)
    table.row(rollouts=0, success=0.34, model_error=0.01234, planner_ms=21.04, seconds=3.2)
    table.row(rollouts=15, success=1.0, **{"return": -3.456}, model_error=float("nan"))
    lines = screen.getvalue().splitlines()
    assert [cell.strip() for cell in lines[0].split("|")] == [
        "rollouts", "success", "return", "model error", "planner ms", "seconds"
    ]  # fmt: skip
    assert [cell.strip() for cell in lines[2].split("|")] == ["0", "34%", "-", "0.0123", "21.0", "3"]
    assert [cell.strip() for cell in lines[3].split("|")] == ["15", "100%", "-3.46", "-", "-", "0"]
    assert len(lines) == 4 and len({len(line) for line in lines}) == 1
    with pytest.raises(ValueError, match="sucess"):
        table.row(sucess=1)
