"""The README is short, leads nowhere that is not there, and quotes commands that work."""

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest

from mpc_sgft import deploy, evaluate, pretrain
from mpc_sgft.command import cli
from mpc_sgft.diagnose.__main__ import parser

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
CODE = re.compile(r"```bash\n(.*?)```|`([^`\n]+)`", re.DOTALL)  # blocks of commands, and code in a line
COMMANDS = {command.name: command for command in (pretrain.COMMAND, deploy.COMMAND, evaluate.COMMAND)}


def quoted(start: str) -> list[list[str]]:
    """The words after `start` of each quoted command that begins with it, without comments and leading variables."""
    lines = [line for block, word in CODE.findall(README) for line in (block or word).splitlines()]
    bare = [re.sub(r"^([A-Z_]+=\S+ )+", "", line.strip()) for line in lines]
    return [shlex.split(line.removeprefix(start), comments=True) for line in bare if line.startswith(start)]


def test_it_is_short_and_narrow() -> None:
    lines = README.splitlines()
    assert len(lines) <= 125
    assert not [line for line in lines if len(line) > 100]


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#]+)[^)]*\)", README))))
def test_its_links_lead_to_files(link: str) -> None:
    assert link.startswith("https://") or (ROOT / link).exists()


@pytest.mark.parametrize("words", quoted("python -m mpc_sgft."), ids=" ".join)
def test_its_commands_are_understood(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    name, *args = words
    if name == "diagnose":
        parser().parse_args(args)
    else:
        assert cli.run(COMMANDS[name], [*args, "--config"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("words", quoted("python -m tools."), ids=" ".join)
def test_its_tools_exist(words: list[str]) -> None:
    assert find_spec(f"tools.{words[0]}") is not None


@pytest.mark.parametrize("goal", sorted({words[0] for words in quoted("make ")}))
def test_its_goals_are_in_the_makefile(goal: str) -> None:
    assert re.search(rf"^{goal}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_it_quotes_each_command_and_both_goals() -> None:
    assert {words[0] for words in quoted("python -m mpc_sgft.")} == {*COMMANDS, "diagnose"}
    assert {words[0] for words in quoted("make ")} >= {"demo", "test"}


def test_the_place_of_the_headline_table_is_marked() -> None:
    before, table = README.split("<!-- headline:begin -->\n")
    assert table.startswith("|") and table.count("\n<!-- headline:end -->") == 1
    assert "headline:" not in before
