"""What was found and how sure it is: report.json, report.html, and report.rrd with all signals side by side."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpc_sgft.diagnose.data.measured import Array
from mpc_sgft.diagnose.page.laws import Laws
from mpc_sgft.diagnose.page.page import Lines, page
from mpc_sgft.diagnose.page.words import changes, headline, place
from mpc_sgft.diagnose.simulation.replay import Replayer


@dataclass
class Report:
    """The answer. `as_dict()` is report.json.

    Attributes:
        data: The keys of report.json.
        measured, nominal, repaired: Signals of all windows for plots, [W, n, S].
        replayer: Windows and signal names.
        laws: What is missing, along what.
        diff: From the nominal scene to the repaired one; empty if nothing was written.
    """

    data: dict[str, Any]
    measured: Array = field(repr=False)
    nominal: Array = field(repr=False)
    repaired: Array = field(repr=False)
    replayer: Replayer = field(repr=False)
    laws: Laws = field(default_factory=Laws)
    diff: str = ""

    @property
    def verdict(self) -> str:
        return self.data["verdict"]

    def as_dict(self) -> dict[str, Any]:
        return self.data

    def write(self, out: Path) -> None:
        """Write report.json, report.html and report.rrd into a folder."""
        (out / "report.json").write_text(json.dumps(self.data, indent=2))
        (out / "report.html").write_text(page(self.data, self.lines(), self.laws, self.diff))
        write_rrd(self, out / "report.rrd")

    def lines(self) -> Lines:
        """All signals over time."""
        w, replayer = self.replayer.windows, self.replayer
        before = np.concatenate([[0.0], np.cumsum([e.seconds for e in replayer.episodes])])
        after = np.arange(1, w.samples + 1)
        time = np.asarray(before[w.episode][:, None] + replayer.dt * (w.start[:, None] + after), float)
        return Lines(replayer.signals, time, self.measured, self.nominal, self.repaired)

    def summary(self) -> str:
        """A few lines for the terminal."""
        d = self.data
        lines = [headline(d), f"verdict: {d['verdict']} ({d['reason']})"]
        for e in d["effects"]:
            numbers = ", ".join(
                f"{k} = {v['value']:.4g}{_unit(v)} [{v['low']:.4g}, {v['high']:.4g}]"
                for k, v in e["parameters"].items()
            )
            lines.append(f"  {e['name']} at {place(e)}: {numbers}; {_share(e)}")
        for tie in d["ties"]:
            lines.append(f"  ties with: {' + '.join(tie['effects'])} {tie['reason']}")
        for e in d["traces"]:
            numbers = ", ".join(f"{k} = {v['value']:.4g}{_unit(v)}" for k, v in e["parameters"].items())
            lines.append(f"  trace: {e['name']} at {place(e)}: {numbers}; {_share(e)}")
        h = d["held_out"]
        lines.append(
            f"held-out {h['signal']}: {h['nominal']:.4g} -> {h['repaired']:.4g} {h['unit']}, {h['reduction']:.0%} less "
            f"[{h['low']:.0%}, {h['high']:.0%}]"
        )
        if d["next_experiment"]:
            lines.append(f"next experiment: {d['next_experiment']}")
        return "\n".join([*lines, *(f"note: {n}" for n in d["notes"])])


def _unit(parameter: dict[str, Any]) -> str:
    return "" if parameter["unit"] == "1" else f" {parameter['unit']}"


def _share(effect: dict[str, Any]) -> str:
    """What an effect does, in words."""
    moved = ", ".join(changes(effect))
    return f"{effect['share']['value']:.2%} of the squared error" + (f", moves {moved}" if moved else "")


def write_rrd(report: Report, path: Path) -> None:
    """Measured, nominal and repaired signals over time."""
    import rerun as rr

    rec = rr.RecordingStream("mpc_sgft_diagnose")
    rec.save(str(path))
    t = report.lines().time
    order = np.argsort(t.ravel())
    index = [rr.TimeColumn("time", duration=t.ravel()[order])]
    for i, name in enumerate(report.replayer.signals):
        for kind in ("measured", "nominal", "repaired"):
            values = getattr(report, kind)[..., i].ravel()[order]
            rec.send_columns(f"{name}/{kind}", indexes=index, columns=rr.Scalars.columns(scalars=values))
    rec.flush()
    rec.disconnect()
