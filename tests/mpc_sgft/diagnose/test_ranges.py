"""What a deployment recorded narrows the randomisation down to what explains it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.deployments.ranges import find_ranges, randomisation
from mpc_sgft.diagnose.deployments.recordings import read_deployment

ON_ICE: dict[str, dict] = {  # weak in nothing, late by 0.1 s; factors: friction 0.8, mass 1.6
    "actuator_delay": {"delay": 0.1},
    "contact_friction": {"coefficient": 0.32, "at": ["puck"]},
    "payload": {"mass": 0.06, "at": ["puck"]},
}
TRUTH = {"latency": (0.1, 0.15), "gain": (1.0, 0.75), "friction": (0.8, 0.75), "mass": (1.6, 1.5)}  # and width of range


def test_a_late_machine_is_found_among_the_draws(deployed) -> None:
    run = deployed(ON_ICE, episodes=6)
    draws = find_ranges(read_deployment(run), randomisation(run, "push"), seed=0).randomize["draws"]
    for name in ("latency", "gain"):
        told(draws[name], *TRUTH[name], name)
    assert draws["friction"]["high"] < 0.9, draws["friction"]


@pytest.mark.xfail(reason="mass and friction are not told for certain: seed and processor decide")
def test_a_late_machine_on_ice_is_found_among_the_draws(deployed) -> None:
    run = deployed(ON_ICE, episodes=6)
    found = find_ranges(read_deployment(run), randomisation(run, "push"), seed=0, rounds=5, samples=24)
    for name, truth in TRUTH.items():
        told(found.randomize["draws"][name], *truth, name)


def told(found: dict[str, float], value: float, width: float, name: str) -> None:
    low, high = found["low"], found["high"]
    assert low - 0.05 * width < value < high + 0.05 * width, (name, low, high)
    assert high - low < 0.5 * width, f"{name} is told: {low} to {high}"


def test_the_command_writes_what_pretraining_takes(deployed, tmp_path: Path, capsys) -> None:
    run = deployed({"viscous_friction": {"coefficient": 0.03}}, task_name="pendulum")
    assert main(["--run", str(run), "--ranges", "pendulum"]) == 0
    said = capsys.readouterr().out
    path = run / "diagnosis" / "ranges.yaml"
    assert "looked for within" in said and "at an end" not in said and str(path) in said
    found = yaml.safe_load(path.read_text())["draws"]
    low, high = found["damping"]["low"], found["damping"]["high"]
    assert low < 1.6 < high and high - low < 0.2, "0.05 and 0.03 N m s/rad"
    assert 0.99 < found["mass"]["low"] < 1.0 < found["mass"]["high"] < 1.01
    given = compose.spread(["task=pendulum", f"randomize={path}"])
    cfg = compose.compose("pretrain", [compose.normalise(text) for text in given], given)
    assert cfg.randomize.draws == found and cfg.randomize.noise_sd == 0


def test_a_truth_beyond_the_ranges_is_suspected(deployed) -> None:
    run = deployed({"viscous_friction": {"coefficient": 0.08}}, task_name="pendulum", episodes=3)
    found = find_ranges(read_deployment(run), randomisation(run, "pendulum"), seed=0)
    assert found.at_an_end == ["damping"] and "at an end of its range: damping; look within a wider" in found.table()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--ranges", "none"], "nothing is drawn there"),
        (["--ranges", "pusch"], "pusch"),
        (["--ranges", "push"], "puck"),
        (["--ranges", "pendulum", "--effects", "payload"], "--effects does not go with --ranges"),
    ],
)
def test_what_cannot_be_looked_for(words: list[str], message: str, deployed, capsys) -> None:
    run = deployed({}, task_name="pendulum", episodes=2)
    assert main(["--run", str(run), *words]) == 2
    assert message in capsys.readouterr().err
    assert main(words) == 2, "without --run"


def test_a_folder_that_is_no_deployment(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        randomisation(tmp_path / "none", "push")
