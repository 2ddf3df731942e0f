"""Small loops in place of the commands' own, for tests of what stands before them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from mpc_sgft.command import cli


def probe(loop: str = "", name: str = "deploy") -> cli.Command:
    """A command whose loop is a function of the module that `loops` writes."""
    return cli.Command(name=name, loop=f"probe_loop:{loop}", summary="")


@pytest.fixture
def loops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module of small loops beside an empty working folder, which it returns."""
    (tmp_path / "probe_loop.py").write_text(
        "import errno, gc\n"
        "imported = gc.isenabled()\n"
        "from mpc_sgft.storage import run_folder\n"
        "from mpc_sgft.command.errors import Stopped\n"
        "def folder(cfg):\n    made = run_folder.start(cfg)\n    run_folder.keep_told(cfg, made)\n    print(made)\n"
        "def show(cfg):\n    print(cfg.seed, cfg.chosen.gap, cfg.planner.horizon)\n"
        "def compose_anew(cfg):\n"
        "    from mpc_sgft.command.compose import compose\n"
        "    print(cfg.seed, compose('pretrain', ['seed=7'], []).seed)\n"
        "def stop(cfg):\n    raise Stopped('Saved. Go on with: --resume runs/x')\n"
        "def full(cfg):\n    raise OSError(errno.ENOSPC, 'No space left on device', 'runs/x/metrics.csv')\n"
        "def garbage(cfg):\n    print(imported, gc.isenabled(), gc.get_freeze_count() > 0)\n"
        "def bug(cfg):\n    raise OSError(errno.EPIPE, 'Broken pipe')\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("probe_loop", None)
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return work
