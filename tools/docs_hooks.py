"""What MkDocs fills in while it builds: results, settings, effects, equations. Nothing of these is typed twice."""

import dataclasses
import re
import shutil
from pathlib import Path
from typing import Any

import yaml
from latex2mathml.converter import convert

from mpc_sgft.command import choices
from tools import results_page, timing_tables
from tools.ladder_table import ladder
from tools.tables import RESULTS, table

ROOT = Path(__file__).resolve().parents[1]
MATH = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_pre_build(config: Any) -> None:
    """Copy the pictures of results/ to where the page looks for them."""
    pictures = Path(config["docs_dir"]) / "results"
    shutil.rmtree(pictures, ignore_errors=True)
    for png in sorted(RESULTS.glob("*/*.png")):
        (pictures / png.parent.name).mkdir(parents=True, exist_ok=True)
        shutil.copy(png, pictures / png.parent.name / png.name)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill the places that are marked {{ so }}."""
    fills = {"results": results_page.page, "ladder": ladder}
    fills |= {
        "collect": timing_tables.collect,
        "growth": timing_tables.growth,
        "gpu": timing_tables.gpu,
        "thousand": timing_tables.thousand,
        "settings": settings,
    }
    for name, fill in {**fills, "effects": effects}.items():
        mark = "{{ " + name + " }}"
        if mark in markdown:
            markdown = markdown.replace(mark, fill())
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """Equations become MathML, which browsers draw themselves."""
    return MATH.sub(lambda m: convert(_plain(m[2]), display="block" if m[1] == "div" else "inline"), html)


def _plain(tex: str) -> str:
    return tex.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&").strip()


def settings() -> str:
    """Every yaml of configs/ but the gaps, with its comments: the one place where a number lives."""
    parts = ["### The commands' own", *(_block(path) for path in sorted(choices.CONFIG_DIR.glob("*.yaml")))]
    for group, names in choices.groups().items():
        if group == "gap":
            continue
        parts.append(f"### {group}\n\n{group}= " + ", ".join(f"`{name}`" for name in names))
        parts += [_block(choices.CONFIG_DIR / group / f"{name}.yaml") for name in names]
    rows = []
    for path in sorted((choices.CONFIG_DIR / "gap").glob("*.yaml")):
        what = yaml.safe_load(path.read_text()).get("effects") or {}
        rows.append([f"`{path.stem}`", "; ".join(f"{k} {v}" for k, v in what.items()).replace("|", "\\|") or "nothing"])
    return "\n\n".join([*parts, "### gap", table(["gap=", "what is hidden"], rows)])


def _block(path: Path) -> str:
    """A file of configs/ that is shown when it is clicked on."""
    name, text = path.relative_to(choices.CONFIG_DIR), path.read_text().rstrip()
    return f'??? note "`configs/{name}`"\n\n    ```yaml\n' + _indent(text) + "\n    ```"


def _indent(text: str) -> str:
    return "\n".join("    " + line if line else "" for line in text.splitlines())


def effects() -> str:
    """The effects, by the first line of what each file says of itself, and their parameters."""
    from importlib import import_module

    from envs.effects import available

    rows = []
    for name in available():
        module = import_module(f"envs.effects.{name}")
        line = (module.__doc__ or "").strip().splitlines()[0]
        parameters = [_parameter(module.EFFECT, field) for field in dataclasses.fields(module.EFFECT)]
        rows.append([f"`{name}`", line, "; ".join(parameters)])
    return table(["effect", "what reality has", "parameters"], rows)


def _parameter(effect: Any, field: dataclasses.Field) -> str:
    """Name, unit, bounds and default of a parameter."""
    said = [unit] if (unit := effect.units.get(field.name)) else []
    if field.name in effect.bounds:
        said.append("{:g} to {:g}".format(*effect.bounds[field.name]))
    if field.default not in (dataclasses.MISSING, None, ()):
        said.append(f"{field.default} if not given")
    return f"`{field.name}`" + (f" ({', '.join(said)})" if said else "")
