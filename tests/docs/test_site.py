"""What the hooks of the documentation make, and that every page they speak of is there."""

from __future__ import annotations

import re
from pathlib import Path

from tools import docs_hooks

ROOT = Path(__file__).resolve().parents[2]


def test_every_fill_leaves_no_mark_behind() -> None:
    text = docs_hooks.on_page_markdown("{{ results }}\n{{ settings }}\n{{ effects }}")
    assert (
        "{{ results" not in text and "`turned`" in text and "`stribeck_friction`" in text and "num_elites: 96" in text
    )
    assert "`gain` (1, -5 to 5, 1.0 if not given)" in text and "eval_every: " in text


def test_blocks_that_open_when_clicked_on_are_known() -> None:
    assert "??? note" in docs_hooks.settings() and "pymdownx.details" in (ROOT / "mkdocs.yml").read_text()


def test_equations_become_mathml() -> None:
    html = docs_hooks.on_page_content('<p><span class="arithmatex">\\(a &lt; b_t\\)</span></p>')
    assert html.startswith("<p><math") and "<msub><mi>b</mi>" in html and ("&lt;" in html or "&#x0003C;" in html)


def test_links_between_pages_lead_somewhere() -> None:
    """`make docs` is strict about it, too; this needs no generator."""
    wrong = []
    for page in (ROOT / "docs").rglob("*.md"):
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text()):
            if not (page.parent / target).exists():
                wrong.append(f"{page.relative_to(ROOT)}: {target}")
    assert not wrong
