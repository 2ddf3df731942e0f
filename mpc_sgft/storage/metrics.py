"""Numbers of a run on their way to metrics.csv, TensorBoard, wandb and the terminal."""

import csv as csv_file
import io
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self, TextIO

import numpy as np
from tqdm import tqdm

from mpc_sgft.command.errors import UserError
from mpc_sgft.storage.whole_file import naming, write_whole

AWAY = "Move it away to resume: later rows then go into a new one."


class MetricLogger:
    """One row of scalars per call of log(), on disk when it returns.

    metrics.csv has the column `step` first and the other keys in the order in which they first appeared; a new key adds
    a column, and rows that lack a key stay empty there. TensorBoard files lie in `run_dir/tensorboard`.

    Args:
        run_dir: Folder of the run; must exist.
        csv: Write `run_dir/metrics.csv`.
        tensorboard: Write TensorBoard event files.
        wandb: Also log to Weights & Biases, under its own settings and environment variables.
        resume_step: None for a new run. On resume the last step to keep: rows after it are dropped, because the
            resumed run will log them again.

    Raises:
        FileExistsError: If metrics.csv is there and resume_step is None.
        UserError: If metrics.csv is there, and no table of metrics.
        ModuleNotFoundError: If wandb is asked for and not installed.
        OSError: With the path, if a file cannot be written, here or in log().
    """

    def __init__(
        self,
        run_dir: str | Path,
        *,
        csv: bool = True,
        tensorboard: bool = True,
        wandb: bool = False,
        resume_step: int | None = None,
    ) -> None:
        run_dir = Path(run_dir)
        self._csv = _CsvTable(run_dir / "metrics.csv", resume_step) if csv else None
        self._wandb = _wandb_run(run_dir, resume_step) if wandb else None
        self._board, self._board_dir = None, run_dir / "tensorboard"
        if tensorboard:
            from torch.utils.tensorboard import SummaryWriter  # imports torch: late, so that --help stays quick

            purge = None if resume_step is None else resume_step + 1
            with naming(self._board_dir):
                self._board = SummaryWriter(str(self._board_dir), purge_step=purge)

    def log(self, step: int, values: Mapping[str, Any]) -> None:
        """Append one row.

        Args:
            step: Position on the horizontal axis, environment steps or rollouts.
            values: Name -> scalar: number, bool, or array or tensor with one element. Names may contain `/`.

        Raises:
            ValueError: If a value is not a scalar, or a name is `step`.
        """
        row = {name: _scalar(name, value) for name, value in values.items()}
        if self._csv is not None:
            self._csv.append(step, row)
        if self._board is not None:
            with naming(self._board_dir):
                for name, value in row.items():
                    self._board.add_scalar(name, value, step)
                self._board.flush()
        if self._wandb is not None:
            self._wandb.log(row, step=step)

    def close(self) -> None:
        if self._csv is not None:
            self._csv.close()
        if self._board is not None:
            self._board.close()
        if self._wandb is not None:
            self._wandb.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _CsvTable:
    """A CSV file that can grow columns; every row is flushed."""

    def __init__(self, path: Path, resume_step: int | None) -> None:
        self._path = path
        self._columns = ["step"]
        if resume_step is None:
            self._file = path.open("x", newline="")
            self._write([self._columns])
            return
        rows = [row for row in self._read() if int(row["step"]) <= resume_step] if path.exists() else []
        self._replace(rows)

    def append(self, step: int, row: Mapping[str, float]) -> None:
        if "step" in row:
            raise ValueError("A metric may not be called 'step': that is the name of the first column.")
        new = [name for name in row if name not in self._columns]
        if new:
            rows = self._read()
            self._columns += new
            self._replace(rows)
        self._write([[str(step), *(_text(row.get(name)) for name in self._columns[1:])]])

    def close(self) -> None:
        self._file.close()

    def _read(self) -> list[dict[str, str]]:
        """All whole rows. What a killed process left half written lacks its line end and is dropped.

        Rows that are damaged, as after a power loss, are left out, and it is said how many.
        """
        text = self._path.read_text(errors="replace")
        if not text.startswith("step"[: len(text)]):
            raise UserError(f"{self._path} is no table of metrics: it starts with {text[:8]!r}. {AWAY}")
        try:
            header, *rows = [*csv_file.reader(text[: text.rfind("\n") + 1].splitlines())] or [self._columns]
        except csv_file.Error as error:
            raise UserError(f"{self._path} is damaged ({error}). {AWAY}") from error
        self._columns = header
        whole = [row for row in rows if len(row) == len(header) and row[0].isdecimal()]
        if len(whole) < len(rows):
            print(f"{self._path}: {len(rows) - len(whole)} damaged rows are left out", file=sys.stderr)
        return [dict(zip(header, row, strict=True)) for row in whole]

    def _replace(self, rows: list[dict[str, str]]) -> None:
        """Write the whole table in place of the old one."""
        text = io.StringIO(newline="")
        writer = csv_file.writer(text, lineterminator="\n")
        writer.writerow(self._columns)
        writer.writerows([row.get(name, "") for name in self._columns] for row in rows)
        write_whole(self._path, text.getvalue().encode())
        self._file = self._path.open("a", newline="")

    def _write(self, rows: list[list[str]]) -> None:
        with naming(self._path):
            csv_file.writer(self._file, lineterminator="\n").writerows(rows)
            self._file.flush()


def _scalar(name: str, value: Any) -> float:
    array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
    if array.size != 1 or array.dtype.kind not in "biuf":
        raise ValueError(f"Metric {name!r} must be one number; got {array.dtype} of shape {array.shape}.")
    return array.item()


def _text(value: float | None) -> str:
    """Shortest text that reads back as the same number; empty for a metric this row does not have."""
    if value is None:
        return ""
    return repr(int(value)) if isinstance(value, bool) else repr(value)


def _wandb_run(run_dir: Path, resume_step: int | None) -> Any:
    try:
        import wandb  # pyright: ignore[reportMissingImports]  # optional
    except ModuleNotFoundError as error:
        if error.name != "wandb":
            raise
        message = "log.wandb=true needs the package wandb: `pip install 'mpc_sgft[wandb]'`, or set log.wandb=false."
        raise ModuleNotFoundError(message, name="wandb") from error
    resume = "never" if resume_step is None else "allow"
    name = "-".join(run_dir.resolve().parts[-2:])
    return wandb.init(project="mpc_sgft", id=name, name=name, dir=str(run_dir), resume=resume)


def progress(
    total: int, *, initial: int = 0, desc: str = "", unit: str = "step", disable: bool = False, leave: bool = True
) -> tqdm:
    """A progress bar with the time left; `bar.update(n)` moves it, `bar.set_postfix(success=0.4)` shows numbers.

    Goes to stderr. Where stderr is not a terminal it prints a line every ten seconds instead of redrawing.
    """
    terminal = sys.stderr.isatty()
    return tqdm(
        total=total,
        initial=initial,
        desc=desc,
        unit=unit,
        disable=disable,
        leave=leave,
        dynamic_ncols=terminal,
        mininterval=0.2 if terminal else 10.0,
        ncols=None if terminal else 100,
        smoothing=0.05,
    )


class Column(NamedTuple):
    """A column of a printed table: where its value comes from and how it is written."""

    name: str
    key: str
    form: str = "{}"


EVALUATION_COLUMNS = (
    Column("rollouts", "rollouts", "{:d}"),
    Column("success", "success", "{:.0%}"),
    Column("return", "return", "{:.2f}"),
    Column("model error", "model_error", "{:.4f}"),
    Column("planner ms", "planner_ms", "{:.1f}"),
    Column("seconds", "seconds", "{:.0f}"),
)


class GrowingTable:
    """Prints a table one row at a time, header first; progress bars below it stay intact.

    `seconds` is filled in by the table itself (since its creation) where a row does not give it.
    """

    def __init__(self, columns: tuple[Column, ...] = EVALUATION_COLUMNS, *, file: TextIO | None = None) -> None:
        self._columns = columns
        self._file = file
        self._start = time.monotonic()
        self._header_done = False

    def row(self, **values: float | None) -> str:
        """Print and return one row; None or a missing value prints as `-`.

        Raises:
            ValueError: If a name is none of the columns' keys.
        """
        keys = [column.key for column in self._columns]
        unknown = sorted(set(values) - set(keys))
        if unknown:
            raise ValueError(f"No column for {unknown}. Columns: {keys}.")
        values = {"seconds": time.monotonic() - self._start} | values
        cells = [_cell(column, values.get(column.key)) for column in self._columns]
        widths = [max(len(column.name), 8) for column in self._columns]
        if not self._header_done:
            self._print(" | ".join(c.name.rjust(w) for c, w in zip(self._columns, widths, strict=True)))
            self._print("-+-".join("-" * w for w in widths))
            self._header_done = True
        line = " | ".join(cell.rjust(w) for cell, w in zip(cells, widths, strict=True))
        self._print(line)
        return line

    def _print(self, line: str) -> None:
        file = self._file or sys.stdout
        tqdm.write(line, file=file)
        file.flush()


def _cell(column: Column, value: float | None) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return column.form.format(value)
