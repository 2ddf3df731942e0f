"""The tables of the documentation and of the README are those of the CSVs."""

from __future__ import annotations

import re
from pathlib import Path

from tools import ladder_table, results_page
from tools.results_page import BEGIN, END, headline, page, write_readme
from tools.tables import RESULTS, ROOT, curves


def test_the_readme_quotes_the_files(tmp_path: Path) -> None:
    text = (ROOT / "README.md").read_text()
    copy = tmp_path / "README.md"
    copy.write_text(text)
    write_readme(copy)
    assert copy.read_text() == text, "python -m tools.results_page --readme"
    assert text.index(BEGIN) < text.index(END) and "| `turned`" in headline()


def test_medians_and_ranges_by_hand() -> None:
    rows = [
        {"rollouts": str(n), "success": str(s), "seed": str(k)}
        for k, (first, last) in enumerate([(0.1, 0.9), (0.3, 0.9), (0.2, 0.9)])
        for n, s in ((0, first), (10, last))
    ]
    assert curves(rows, lambda r: "all", "what").splitlines()[-1] == "| all | 3 | 20 % (10–30) | 90 % |"


def test_every_study_is_on_the_page_and_says_how_it_was_made() -> None:
    text = page()
    for folder in sorted(p for p in RESULTS.iterdir() if p.is_dir()):
        assert f"{{ #{folder.name} }}" in text, folder.name
        readme = (folder / "README.md").read_text()
        for fact in ("command", "commit", "machine", "seeds"):
            assert re.search(rf"^- {fact}: \S", readme, re.M), (folder.name, fact)
        assert not re.search(r"\b(TEXT|COMMIT|METHODS)\b", readme), f"{folder.name}: something is left to be filled in"
    assert set(results_page.STUDIES) == {p.name for p in RESULTS.iterdir()}


def test_the_commands_in_results_name_tools_that_are_there() -> None:
    for readme in RESULTS.glob("*/README.md"):
        for module in re.findall(r"python -m (tools\.[\w.]+)", readme.read_text()):
            assert (ROOT / (module.replace(".", "/") + ".py")).is_file(), (readme, module)


def test_rungs_are_named_by_what_they_have() -> None:
    def named(method: str, variant: str) -> str:
        return ladder_table.rung({"method": method, "variant": variant})

    off = [f"{setting}=0" for setting in ladder_table.ADDITIONS if "sparsity" not in setting]
    assert named("sgft", "") == "`sgft`, all of ours then"
    assert named("sgft", " ".join(off)) == "the objective alone"
    assert named("sgft", " ".join(w for w in off if "gate" not in w)) == "gate alone"
    assert named("sgft", "method.anchor=0") == "all but anchor"
    assert named("sgft", "method.win_stay=0") == "all but win-stay"
    assert named("tdmpc2", "method.win_stay=5") == "`tdmpc2` with win-stay"
    assert named("sgft_paper", "method.encoder=false method.reward=false") == "`sgft_paper`, encoder and reward frozen"
    assert named("tdmpc2", "method.terminal=q") == "`tdmpc2` and plans that end in Q, plain"
    assert named("sgft_paper", "method.lr=3e-4") == "`sgft_paper` at TD-MPC2's rate, as published"
    assert named("tdmpc2", "method.lr=null") == "`tdmpc2` at pretraining's rate, plain"
    assert named("tdmpc2", "method.command_map=true method.gate_margin=1") == "`tdmpc2` with command map"
