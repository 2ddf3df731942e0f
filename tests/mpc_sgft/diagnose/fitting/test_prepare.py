"""Windows are seen as a fit sees them: what friction makes of an error of the start is not what a free slide makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose import diagnose
from mpc_sgft.diagnose import run as running
from mpc_sgft.diagnose.candidates.library import make_term
from mpc_sgft.diagnose.data.check import episodes
from mpc_sgft.diagnose.data.measured import Episode, Table, read_table, write_csv
from mpc_sgft.diagnose.data.smooth import noise_of
from mpc_sgft.diagnose.data.units import Axis
from mpc_sgft.diagnose.fitting import search as searching
from mpc_sgft.diagnose.fitting.fit import Discrepancy, fit
from mpc_sgft.diagnose.fitting.hypothesis import Hypothesis, judge_fit
from mpc_sgft.diagnose.fitting.prepare import (
    Problem,
    Setup,
    default_signals,
    default_window,
    near_fit,
    prepare,
    typical,
    typical_sizes,
)
from mpc_sgft.diagnose.rows import notes_of_short
from mpc_sgft.diagnose.simulation.plant import Plant, load_plant


@pytest.fixture
def dry(slide: Path, record) -> tuple[Plant, Setup[Problem]]:
    """A slide that sticks for long, recorded with much noise, before anyone knows of friction."""
    plant = load_plant(slide).sharper()
    table = read_table(record(seconds=8.0, coulomb=15.0, noise=5e-4))
    recorded = episodes(table, plant.actuators, plant.axes())
    return plant, prepare(plant, recorded, [], window=None, signals=None, held_out=None)


def _fit(setup: Setup[Problem], plant: Plant, *sizes: tuple[str, float]) -> Hypothesis:
    terms = [
        make_term(plant, name, "x", typical_sizes(plant, setup.problem.replayer)["joint", "x"]) for name, _ in sizes
    ]
    return judge_fit(setup, fit(setup.problem, terms, [np.array([x]) for _, x in sizes], setup.fitted))


def test_near_the_right_fit_noise_alone_is_left(dry) -> None:
    plant, setup = dry
    far = _fit(setup, plant, ("coulomb_friction", 15.0))
    near = _fit(near_fit(setup, far.fit, plant), plant, ("coulomb_friction", 15.0))
    squares = [float((e.fit.r**2).mean()) for e in (far, near)]
    assert 0.8 < squares[1] < 1.15 < 1.8 < squares[0], squares


def test_judging_again_keeps_the_parts_of_a_set_however_bad_they_are(dry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "REJUDGED", 0)
    plant, setup = dry
    singles = [_fit(setup, plant, (n, 0.1)) for n in ("coulomb_friction", "viscous_friction", "quadratic_drag")]
    pair = _fit(setup, plant, ("viscous_friction", 0.1), ("coulomb_friction", 15.0))
    judged = searching.refit(near_fit(setup, pair.fit, plant), [judge_fit(setup, setup.baseline), *singles, pair], pair)
    assert not judged[0].effects and {e.key for e in judged[1:]} == {pair.key, singles[0].key, singles[1].key}


@pytest.mark.parametrize(("noise", "searched", "judged"), [(5e-4, 2e-3, 1e-3), (2e-5, 2e-3, 5e-4), (1e-7, 5e-4, 5e-4)])
def test_steps_are_as_long_as_noise_hides_their_error(
    noise: float, searched: float, judged: float, slide: Path, record, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: dict[str, list[float]] = {"search": [], "reach_verdict": []}

    def watch(name: str) -> Callable[..., object]:
        inner = getattr(running, name)

        def watched(setup: Setup[Problem], *rest: object, **more: object) -> object:
            steps[name].append(setup.problem.replayer.h)
            return inner(setup, *rest, **more)

        return watched

    for name in steps:
        monkeypatch.setattr(running, name, watch(name))
    report = diagnose(slide, [record(seconds=8.0, coulomb=2.0, noise=noise)], effects=["coulomb_friction"])
    assert report.as_dict()["verdict"] == "effect"
    assert [steps[name][0] for name in steps] == pytest.approx([searched, judged])


def test_what_is_tolerated_is_as_good_as_noise_that_stays_off(slide: Path, record) -> None:
    """Averaging over samples makes noise less, and not what a model leaves out; also near a fit that is found later."""
    plant = load_plant(slide).sharper()
    recorded = episodes(read_table(record(seconds=8.0, noise=1e-3)), plant.actuators, plant.axes())

    def scales(limit: float) -> tuple[np.ndarray, np.ndarray]:
        def limits(signals: object, measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
            assert list(signals) == ["qpos/x"] and measured.shape == predicted.shape  # type: ignore[call-overload]
            return np.array([limit])

        setup = prepare(plant, recorded, [], window=None, signals=None, held_out=None, limits=limits)
        return setup.problem.scale, near_fit(setup, setup.baseline, plant).problem.scale

    strict, loose, silent = scales(1e-9), scales(3e-3), scales(np.inf)
    for before, after, unsaid in zip(strict, loose, silent, strict=True):
        assert after**2 == pytest.approx(before**2 + 9e-6) and before.max() < 1e-3
        assert unsaid == pytest.approx(before)


def test_steps_that_are_off_by_more_than_is_tolerated_show(dry) -> None:
    """However little noise there is: an error of three tolerances is nine tenths of what may be expected."""
    _, setup = dry
    replayer = setup.problem.replayer
    shape, states = replayer.windows.measured.shape, 2 * len(replayer.plant.joints)
    own = Discrepancy(np.zeros(shape), np.full((1, *shape), 3e-3), np.zeros(shape))
    made = Problem(
        replayer, np.array([1e-7]), own, np.array([1e-3]), np.zeros((shape[0], states)), np.zeros((*shape, states))
    )
    assert made.floor_shares == pytest.approx(0.9) and made.scale == pytest.approx(np.sqrt(10) * 1e-3)


def test_what_steps_are_known_to_leave_out_is_no_error_of_the_model(slide: Path, moved, tmp_path: Path) -> None:
    """A stiff slide, recorded in steps of a hundredth: in its own it is off by 1.8 tolerances, as is known."""
    slide.write_text(slide.read_text().replace('axis="1 0 0"/>', 'axis="1 0 0" stiffness="20000" damping="20"/>'))
    model = mujoco.MjModel.from_xml_path(str(slide))
    model.opt.timestep, model.opt.integrator = 2e-5, mujoco.mjtIntegrator.mjINT_RK4
    data, columns = mujoco.MjData(model), moved(seconds=6.0)
    columns["ctrl/motor"] *= 20
    for k, command in enumerate(columns["ctrl/motor"]):
        columns["qpos/x"][k], data.ctrl[0] = data.qpos[0], command
        mujoco.mj_step(model, data, nstep=200)
    columns["qpos/x"] += 2e-7 * np.random.default_rng(0).standard_normal(len(columns["qpos/x"]))
    write_csv(tmp_path / "stiff.csv", columns)
    plant = load_plant(slide).sharper(2e-3)
    recorded = episodes(read_table(tmp_path / "stiff.csv"), plant.actuators, plant.axes())
    setup = prepare(plant, recorded, [], window=None, signals=None, held_out=None)
    assert running.tolerance_of(setup, 0.0005).allows(setup.baseline)


@pytest.mark.parametrize("paused", [True, False])
def test_a_short_piece_after_a_pause_makes_windows_no_shorter(paused: bool) -> None:
    t = np.arange(8000) * 1e-3
    q = np.sin(np.pi * t) + 5e-5 * np.random.default_rng(0).standard_normal(8000)
    there = np.arange(8000) // 10 != 793 if paused else np.ones(8000, bool)
    columns = {"time": t, "ctrl/motor": np.sin(t), "qpos/x": q}
    table = Table("run", {name: x[there] for name, x in columns.items()})
    recorded = episodes(table, ["motor"], {"x": Axis(slide=True)})
    assert len(recorded) == 1 + paused
    assert 0.95 < default_window(recorded, ["x"]) == default_window(recorded[:1], ["x"])
    shorts = [replace(e, piece=False) for e in recorded]  # episodes of their own all count
    assert (default_window(shorts, ["x"]) < 0.1) == paused


def test_episodes_that_fill_no_window_are_told_and_not_held_out(slide: Path, record: Callable[..., Path]) -> None:
    data = [record(name, seconds=s) for name, s in (("a", 8.0), ("b", 8.0), ("c", 0.8), ("d", 0.8))]
    plant = load_plant(slide)
    recorded = [episodes(read_table(path), plant.actuators, plant.axes())[0] for path in data]
    setup = prepare(plant, recorded, [], window=1.0, signals=None, held_out=None)
    w = setup.problem.replayer.windows
    assert set(w.episode[setup.fitted]) == set(w.episode[setup.held]) == {0, 1}
    assert notes_of_short("abcd", w.episode, 1.0) == [
        "not used, too short for a window of 1 s: c, d; a shorter --window uses more"
    ]
    assert not notes_of_short("ab", w.episode, 1.0)
    with pytest.raises(UserError, match=r"held-out episode 'd' is too short for a window. Long enough are: a, b"):
        prepare(plant, recorded, [], window=1.0, signals=None, held_out=["d"])


def test_sensors_of_the_scene_are_compared_too_and_nothing_that_only_ends_like_one() -> None:
    scene = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="0.1" mass="1"/></body></worldbody>
    <actuator><motor name="m" joint="x"/></actuator><sensor><jointpos name="tip" joint="x"/></sensor></mujoco>"""
    names = ["qpos/x", "qvel/x", "qvel/x-tip", "force/m", "sensor/tip", "sensor/heat"]
    episode = Episode("a", 0.01, np.zeros((9, 1)), {n: np.zeros(9) for n in names})
    assert default_signals([episode], Plant(mujoco.MjSpec.from_string(scene))) == ["qpos/x", "force/m", "sensor/tip"]


def test_an_encoder_that_rests_between_steps_hides_no_less_than_one(slide: Path, moved, tmp_path: Path) -> None:
    columns = moved(seconds=5.0, coulomb=2.0, noise=0.0)
    columns["qpos/x"] = 0.05 * np.round(columns["qpos/x"] / 0.05)  # seven of eight samples are as the one before
    write_csv(tmp_path / "coarse.csv", columns)
    plant = load_plant(slide)
    recorded = episodes(read_table(tmp_path / "coarse.csv"), plant.actuators, plant.axes())
    setup = prepare(plant, recorded, [], window=None, signals=None, held_out=None)
    assert setup.noise == pytest.approx([0.05 / np.sqrt(12)])


def test_what_stands_still_says_nothing_of_noise() -> None:
    rng = np.random.default_rng(0)
    shaken = 1e-3 * rng.standard_normal(500)
    still = Episode("still", 0.01, np.zeros((500, 1)), {"qpos/a": np.ones(500), "qpos/b": np.ones(500)})
    moves = Episode("moves", 0.01, np.zeros((500, 1)), {"qpos/a": shaken, "qpos/b": np.ones(500)})
    noise = typical(noise_of, [still, moves, still], ["qpos/a", "qpos/b"])
    assert noise == pytest.approx([1e-3, 1e-3], rel=0.2)  # b moves nowhere: as the other joint
    assert typical(noise_of, [still], ["qpos/a"]) == pytest.approx([1e-15])
