"""The picture of the project, kept true: who may import whom, read from every import statement."""

from __future__ import annotations

import ast
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OURS = {"configs", "envs", "planners", "mpc_sgft", "tools", "tests"}
MAY_IMPORT = {
    "configs": set(),
    "envs": {"envs"},
    "planners": {"planners"},
    "mpc_sgft": {"mpc_sgft", "envs", "planners"},
    "tools": OURS - {"tests"},
    "tests": OURS,
}

ROOMS = {  # of mpc_sgft, lowest first: each may import itself and what is named here
    "command": set(),
    "learning": set(),
    "methods": {"learning"},
    "storage": {"command", "learning"},
    "session": {"command", "storage"},
    "views": {"command", "learning", "storage"},
    "runs": {"command", "learning", "methods", "storage", "session", "views"},
    "diagnose": {"command", "learning", "methods", "storage", "views", "runs"},
}
DIAGNOSE = {  # the rooms inside it, likewise; what stands beside them may import them all
    "data": set(),
    "simulation": {"data"},
    "candidates": {"data", "simulation"},
    "fitting": {"data", "simulation", "candidates"},
    "verdict": {"data", "simulation", "candidates", "fitting"},
    "page": {"data", "simulation", "candidates", "fitting", "verdict"},
    "deployments": {"data", "simulation", "candidates", "fitting", "verdict", "page"},
}


def imported(source: str) -> set[str]:
    """Top-level names of everything a module imports; a relative import counts as "."."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add("." if node.level else (node.module or "").split(".")[0])
    return found


def files(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_imports_point_one_way(room: str) -> None:
    wrong = []
    for path in files(room):
        for name in imported(path.read_text()):
            if name == "." or (name in OURS and name not in MAY_IMPORT[room]):
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong, wrong


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def modules_imported(source: str, known: set[str]) -> set[str]:
    """Those of `known` that a module imports, at its top or inside a function."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            found |= {f"{base}.{a.name}" if f"{base}.{a.name}" in known else base for a in node.names}
    return found & known


def graph(rooms: tuple[str, ...]) -> dict[str, set[str]]:
    """Who imports whom among our modules; a package's own `__init__` may gather what is in it."""
    paths = {module_of(p): p for room in rooms for p in files(room)}
    return {name: modules_imported(p.read_text(), set(paths)) - {name} for name, p in paths.items()}


def test_the_rooms_of_mpc_sgft_point_one_way() -> None:
    inside = {p.name for p in (ROOT / "mpc_sgft").iterdir() if (p / "__init__.py").is_file()}
    assert inside == set(ROOMS)
    wrong = []
    for name, others in graph(("mpc_sgft",)).items():
        room = name.split(".")[1] if name.count(".") > 1 else name.removeprefix("mpc_sgft.")
        allowed = {room} | ROOMS[room] if room in ROOMS else {"command"}  # the entry points parse, then start a loop
        allowed |= {"learning", "runs"} if room in ("api", "benchmark") else set()
        for other in others - {"mpc_sgft"}:
            if other.split(".")[1] not in allowed:
                wrong.append(f"{name} imports {other}")
    assert not wrong, wrong


def test_the_rooms_of_diagnose_point_one_way() -> None:
    inside = {p.name for p in (ROOT / "mpc_sgft" / "diagnose").iterdir() if (p / "__init__.py").is_file()}
    assert inside == set(DIAGNOSE)
    wrong = []
    for name, others in graph(("mpc_sgft/diagnose",)).items():
        room = name.split(".")[2] if name.count(".") > 1 else ""
        for other in others if room in DIAGNOSE else ():
            if other.count(".") < 2 or other.split(".")[2] not in {room} | DIAGNOSE[room]:
                wrong.append(f"{name} imports {other}")
    assert not wrong, wrong


def test_no_modules_import_each_other_in_a_circle() -> None:
    left = graph(("envs", "planners", "mpc_sgft", "tools"))
    while left:
        last = {name for name, others in left.items() if not others & set(left)}
        assert last, {name: others & set(left) for name, others in left.items()}
        left = {name: others for name, others in left.items() if name not in last}


@pytest.mark.parametrize("room", ["envs", "planners"])
def test_the_inner_rooms_know_no_hydra(room: str) -> None:
    wrong = [str(p.relative_to(ROOT)) for p in files(room) if imported(p.read_text()) & {"hydra", "omegaconf"}]
    assert not wrong, wrong


def test_planners_need_nothing_but_torch() -> None:
    allowed = sys.stdlib_module_names | {"torch", "planners"}
    wrong = {str(p.relative_to(ROOT)): extra for p in files("planners") if (extra := imported(p.read_text()) - allowed)}
    assert not wrong, wrong


def test_every_package_on_disk_is_in_the_wheel() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    rooms = ("configs", "envs", "planners", "mpc_sgft")
    found = {".".join(p.parent.relative_to(ROOT).parts) for room in rooms for p in files(room)}
    assert listed == found


def test_the_reader_of_imports_sees_them_all() -> None:
    source = "import a.b\ndef f():\n    from c.d import e\nfrom . import g\n"
    assert imported(source) == {"a", "c", "."}
