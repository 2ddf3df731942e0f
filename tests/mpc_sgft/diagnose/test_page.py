"""report.html in a real browser: nothing fails, nothing runs out of the window, charts zoom, and it stays small."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose.page.charts import Chart, named, ticks
from mpc_sgft.diagnose.page.page import Lines, _signals
from mpc_sgft.diagnose.simulation.plant import load_plant
from mpc_sgft.diagnose.verdict.repair import diff, nominal_spec

PROBE = """<script>
const box = document.querySelector('svg[data-zoom]').getBoundingClientRect(), y = box.top + box.height / 2;
const send = (kind, share) => document.querySelector('svg[data-zoom]').dispatchEvent(
  new PointerEvent(kind, {clientX: box.left + share * box.width, clientY: y, bubbles: true}));
send('pointerdown', .4); send('pointermove', .6); send('pointerup', .6);
document.title = JSON.stringify({
  page: document.documentElement.scrollWidth, window: innerWidth,
  zoom: document.querySelector('svg[data-zoom] .plot').getAttribute('transform')});
</script>"""


@pytest.fixture(scope="module")
def browser() -> str:
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if not found:
        pytest.skip("needs a browser: chromium or google-chrome")
    return found


@pytest.fixture
def report(slide: Path, record: Callable[..., Path], tmp_path: Path) -> Path:
    data = [
        record(coulomb=2.0, viscous=0.02, extra=lambda q, v: 0.02),
        record(name="<b>odd", coulomb=2.0, viscous=0.02, extra=lambda q, v: 0.02),
    ]
    diagnose(slide, data, effects=["coulomb_friction", "viscous_friction", "actuator_offset"], out=tmp_path / "out")
    return tmp_path / "out" / "report.html"


def test_the_page_holds_the_answer_in_words_charts_and_a_diff(report: Path) -> None:
    page, d = report.read_text(), json.loads((report.parent / "report.json").read_text())
    assert len(page) < 3e6 and "http" not in page.replace("http://www.w3.org/2000/svg", "")
    assert re.search(
        r"<h1>The model lacks this: joint x has [12]\.\d+ N more dry friction\. With that in it, the error", page
    )
    assert [s["what"] for s in d["waterfall"]] == ["nominal", "+ coulomb_friction@x", "traces", "noise"]
    assert d["waterfall"][0]["rms"] > 50 * d["waterfall"][1]["rms"] > 50 * 0.9 * d["waterfall"][3]["rms"]
    assert re.search(r"<span class='add'>\+.*frictionloss=&quot;", page), "the diff of the scene"
    assert "missing force [N]" in page and "There, but too small to matter" in page and "rerun report.rrd" in page
    assert "<b>odd" not in page


def test_no_error_and_no_sideways_scroll_in_a_browser(
    slide: Path, record: Callable[..., Path], browser: str, tmp_path: Path
) -> None:
    data = [record(name=name, seconds=3.0, coulomb=2.0) for name in ("one", "<b>odd")]
    diagnose(slide, data, effects=["coulomb_friction", "viscous_friction"], out=tmp_path / "out")
    probe = tmp_path / "probe.html"
    probe.write_text((tmp_path / "out" / "report.html").read_text().replace("</body>", PROBE + "</body>"))
    given = ["--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--enable-logging=stderr"]
    given += ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
    given += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000", "--window-size=1600,1000"]
    for width in (400, 1400):
        frame = tmp_path / "frame.html"  # a window is never narrower than 500 pixels, a frame is
        frame.write_text(
            f"<iframe id='f' src='probe.html' style='width:{width}px;height:900px;border:0' "
            "onload='document.title = this.contentDocument.title'></iframe>"
        )
        line = [browser, *given, "--dump-dom", frame.as_uri()]
        ran = subprocess.run(line, capture_output=True, text=True, timeout=120, check=True)
        assert "CONSOLE" not in ran.stderr, [line for line in ran.stderr.splitlines() if "CONSOLE" in line]
        title = re.search(r"<title>(.*?)</title>", ran.stdout)
        assert title, ran.stderr[-500:]
        told = json.loads(title[1])
        assert told["window"] == width and told["page"] <= width
        assert float(re.search(r"scale\(([\d.]+)", told["zoom"])[1]) > 3  # pyright: ignore[reportOptionalSubscript]


def test_the_missing_force_of_dry_friction_is_a_step_and_the_repair_takes_it_away(
    slide: Path, record: Callable[..., Path]
) -> None:
    (law,) = diagnose(slide, [record(coulomb=2.0)], effects=["coulomb_friction"]).laws.laws
    along = dict(law.along)
    assert law.where == "x" and law.missing == "missing force [N]" and law.after is not None
    assert [*along] == ["speed [m/s]", "position [m]", "command"]
    for direction in (-1, 1):
        moving = direction * along["speed [m/s]"] > 0.2
        assert np.median(law.before[moving]) == pytest.approx(-2.0 * direction, abs=0.4)  # smoothed over 0.3 s
        assert abs(np.median(law.after[moving])) < 0.4


def test_a_diff_is_from_the_scene_as_it_was_given(slide: Path, tmp_path: Path) -> None:
    repaired = tmp_path / "repaired.xml"
    spec = nominal_spec(load_plant(slide))
    spec.joint("x").frictionloss = 3.5
    spec.compile()
    repaired.write_text(spec.to_xml())
    lines = diff(nominal_spec(load_plant(slide)), repaired).splitlines()
    changed = [line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    assert len(changed) == 2 and 'frictionloss="3.5"' in changed[1] and changed[1][0] == "+"


def test_places_on_an_axis() -> None:
    chart = Chart(200, 100, (0.0, 10.0), (-1.0, 1.0), ("x", "y"), left=50, right=50)
    assert chart.px(np.array([0.0, 5.0, 10.0])) == pytest.approx([50, 100, 150])
    assert chart.py(0.0) == pytest.approx((100 - 38 + 10) / 2)
    logarithmic = Chart(200, 100, (0.01, 1.0), (0, 1), ("x", "y"), left=50, right=50, log_x=True)
    assert logarithmic.px(np.array([0.01, 0.1, 1.0])) == pytest.approx([50, 100, 150])
    assert ticks(0.0, 10.0) == [0, 2, 4, 6, 8, 10] and ticks(0.01, 1.0, log=True) == pytest.approx([0.01, 0.1, 1.0])
    assert ticks(-0.3, 0.3) == pytest.approx([-0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3])
    broken = Chart(200, 100, (0, 3), (0, 1), ("x", "y"))
    broken.line(np.arange(4.0), np.array([0.0, np.nan, 1.0, 0.5]), "measured")
    assert broken.inside[0].count("M") == 2


def test_names_of_ticks_tell_them_apart() -> None:
    assert named([0.0, 0.5, 1.0], 3) == [(0.0, "0"), (0.5, "0.5"), (1.0, "1")]
    assert [name for _, name in named([100.001, 100.002, 100.0025], 3)] == ["100.001", "100.002", "100.0025"]


def test_the_worst_signals_are_drawn_and_single_samples_show() -> None:
    names = [f"qpos/{letter}" for letter in "abcdefgh"]
    worst = [{"signal": name, "unit": "rad"} for name in ("elsewhere", *reversed(names))]  # what no line shows, too
    found = {}
    for n in (1, 5):
        time, values = np.arange(3.0 * n).reshape(3, n), np.ones((3, n, len(names)))
        found[n] = _signals({"signals": worst}, Lines(names, time, values, values + 1, values))
        drawn = re.findall(r"<title>(\S+): measured", found[n])
        assert drawn == names[:1:-1] and "The 6 with the largest error" in found[n]
    assert 'class="line' in found[5] and 'class="dots' not in found[5]
    assert 'class="dots measured' in found[1] and 'class="line' not in found[1]
