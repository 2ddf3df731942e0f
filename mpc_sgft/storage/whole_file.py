"""Files that are complete or not there: a full disk or a kill leaves the earlier one."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an OSError out with the file that was wanted: one of a write names none.

    Raises:
        OSError: The same one, with the path.
    """
    try:
        yield
    except OSError as err:
        if err.errno is None:  # not of the system: its words are all it has
            raise
        raise OSError(err.errno, err.strerror, str(path)) from err


def write_whole(path: Path, data: bytes) -> None:
    """Write beside `path`, flush to disk, then take its place in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with naming(path):
            with open(temporary, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
