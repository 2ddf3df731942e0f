"""What a user can get wrong, and what they are told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from mpc_sgft.command.errors import UserError
from mpc_sgft.diagnose.__main__ import main
from mpc_sgft.diagnose.data.check import episodes
from mpc_sgft.diagnose.data.measured import Table, read_table, write_csv
from mpc_sgft.diagnose.data.sources import opened, sources
from mpc_sgft.diagnose.data.units import Axis
from mpc_sgft.diagnose.fitting.prepare import split
from mpc_sgft.diagnose.run import read
from mpc_sgft.diagnose.simulation.plant import load_plant

CHIRP = np.sin(1e-3 * np.arange(209) ** 2)
RANGES = {"x": Axis(-2.0, 2.0, slide=True)}


def _table(**changed: np.ndarray) -> Table:
    t = np.arange(200) * 0.01
    columns = {"time": t, "ctrl/motor": np.sin(t), "qpos/x": 0.1 * np.cos(t)}
    return Table("run1", {**columns, **{k.replace("__", "/"): v for k, v in changed.items()}})


def test_a_good_table_becomes_one_episode() -> None:
    (episode,) = episodes(_table(), ["motor"], RANGES)
    assert episode.ctrl.shape == (200, 1) and episode.dt == pytest.approx(0.01) and set(episode.signals) == {"qpos/x"}


def test_a_misnamed_column_is_told_with_the_nearest_name() -> None:
    table = _table()
    table.columns["qpos/slide_x"] = table.columns.pop("qpos/x")
    with pytest.raises(UserError, match=r"qpos/x \(nearest: qpos/slide_x\).*The file has: time, ctrl/motor.*joints x"):
        episodes(table, ["motor"], RANGES)


def test_an_actuator_that_the_model_lacks() -> None:
    with pytest.raises(UserError, match="ctrl/arm: the model has no such actuator. It has: motor"):
        episodes(_table(ctrl__arm=np.zeros(200)), ["motor"], RANGES)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"time": np.r_[np.arange(100), np.arange(100)] * 0.01}, "time does not increase at row 100"),
        ({"time": np.arange(200) * 10.0}, "is this milliseconds"),
        ({"qpos__x": np.r_[np.ones(7), np.nan, np.ones(192)]}, "qpos/x is not a number in row 7"),
        ({"qpos__x": 30 * np.cos(np.arange(200))}, "centimetres"),
        ({"qpos__x": 1000 * np.cos(np.arange(200))}, "millimetres"),
        ({"qvel__x": -100 * np.sin(np.arange(200) * 0.01)}, "1e[+]03 times the derivative"),
        ({"qpos__x": CHIRP[9:], "ctrl__motor": CHIRP[:-9]}, "9 samples earlier.*swapped"),
        ({"qpos__x": np.zeros(200), "ctrl__motor": np.ones(200)}, "no joint moves, and the commands are constant"),
    ],
)
def test_numbers_that_cannot_be(changed: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(UserError, match=message):
        episodes(_table(**changed), ["motor"], RANGES, {"motor": "x"})


def test_columns_that_mean_nothing_are_told_with_the_nearest_name() -> None:
    table = _table(qvell__x=np.zeros(200), torque__motor=np.zeros(200), sensor__temperature=np.zeros(200))
    (episode,) = episodes(table, ["motor"], RANGES)
    assert "not used: qvell/x (is it qvel/x?), torque/motor" in episode.notes[0]
    assert "temperature" not in episode.notes[0]


def test_a_constant_command_is_told() -> None:
    (episode,) = episodes(
        _table(ctrl__motor=np.ones(200)), ["motor"], RANGES
    )  # a joint that swings out still tells much
    assert any("the commands are constant" in note for note in episode.notes)
    with pytest.raises(UserError, match="no joint moves, and the commands are constant"):
        episodes(_table(ctrl__motor=np.ones(200), qpos__x=np.ones(200)), ["motor"], RANGES)


def test_missing_time() -> None:
    table = _table()
    del table.columns["time"]
    with pytest.raises(UserError, match="columns missing: time"):
        episodes(table, ["motor"], RANGES)


def test_a_pause_splits_the_recording() -> None:
    time = np.r_[np.arange(100) * 0.01, 5 + np.arange(100) * 0.01]
    first, second = episodes(_table(time=time), ["motor"], RANGES)
    assert len(first.ctrl) == len(second.ctrl) == 100 and "1 pauses" in first.notes[0]


def test_a_recording_of_pauses_alone_is_refused_and_what_is_lost_is_told() -> None:
    time = (np.arange(200) + 10 * (np.arange(200) // 40)) * 0.01
    with pytest.raises(UserError, match="run1: 4 pauses in the recording, and no piece between them has 50 samples"):
        episodes(_table(time=time), ["motor"], RANGES)
    long = (np.arange(200) + 10 * (np.arange(200) >= 160)) * 0.01
    (episode,) = episodes(_table(time=long), ["motor"], RANGES)
    assert "read as 1 episodes; 40 samples in pieces shorter than 50 were left out" in episode.notes[0]


def test_all_recordings_are_read_on_one_clock(tmp_path: Path) -> None:
    """The second one's samples come 0.4 % later: twelve samples at its end, where its commands must not be early."""
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body></worldbody>'
        '<actuator><motor name="motor" joint="x"/></actuator></mujoco>'
    )
    for name, dt in (("a", 0.01), ("b", 0.01004)):
        t = np.arange(3000) * dt
        write_csv(tmp_path / f"{name}.csv", {"time": t, "ctrl/motor": np.sign(np.sin(t)), "qpos/x": 0.1 * np.cos(t)})
    _, (first, second) = read(load_plant(scene), [tmp_path / "a.csv", tmp_path / "b.csv"])
    assert first.dt == pytest.approx(second.dt, rel=1e-9) and not first.notes
    assert "b: read at a sample every 0.01 s" in second.notes[0]
    t = np.arange(len(second.ctrl)) * second.dt
    assert len(t) == 3011
    np.testing.assert_allclose(second.signals["qpos/x"], 0.1 * np.cos(t), atol=1e-7)
    assert (second.ctrl[:, 0] != np.sign(np.sin(t))).sum() <= 10, "a sample late at each of the reversals at most"


def test_what_keeps_an_activation_is_refused() -> None:
    with pytest.raises(UserError, match="actuator 'v' keeps an activation that a recording does not tell"):
        load_plant(
            mujoco.MjSpec.from_string(
                '<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body></worldbody>'
                '<actuator><intvelocity name="v" joint="x" kp="50" actrange="-1 1"/></actuator></mujoco>'
            )
        )


def test_every_recording_of_a_name_is_held_out() -> None:
    recorded = [SimpleNamespace(name=name) for name in ("ep0", "ep1", "ep0")]
    windows = SimpleNamespace(episode=np.repeat([0, 1, 2], 4), start=np.arange(12))
    fitted, held = split(SimpleNamespace(windows=windows, episodes=recorded), ["ep0"])
    assert fitted.tolist() == [4, 5, 6, 7] and len(held) == 8


def test_parquet_that_is_no_table_of_numbers_is_one_line(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    for name, table, says in (
        ("nested", pa.table({"time": [{"s": 1}]}), "cannot be read as Parquet with numeric columns"),
        ("none", pa.table({"time": pa.array([], pa.float64())}), "empty. A Parquet episode has one row per sample"),
    ):
        pq.write_table(table, tmp_path / f"{name}.parquet")
        with pytest.raises(UserError, match=says):
            read_table(tmp_path / f"{name}.parquet")


def test_scattered_stamps_do_not_move_the_commands() -> None:
    rng, ticks = np.random.default_rng(0), np.arange(2000) * 0.01
    time, ctrl = ticks + rng.uniform(-0.002, 0.002, 2000), rng.normal(size=2000)
    table = _table(time=time, ctrl__motor=ctrl, qpos__x=np.sin(time))
    (episode,) = episodes(table, ["motor"], RANGES)
    assert abs(episode.dt - 0.01) < 1e-6
    np.testing.assert_array_equal(episode.ctrl[:, 0], ctrl)
    (again,) = episodes(table, ["motor"], RANGES, clock=episode.dt)
    assert (again.ctrl[:1999, 0] == ctrl[:1999]).mean() > 0.999, "nor on a clock that is given"
    np.testing.assert_allclose(episode.signals["qpos/x"], np.sin(ticks), atol=3e-4)  # the stamps are off by up to 2e-3


def test_much_scatter_lost_rows_and_a_late_stamp_do_not_move_the_commands() -> None:
    rng, ticks = np.random.default_rng(1), np.arange(2000)
    ctrl, there = rng.normal(size=2000), ~np.isin(ticks, [300, 301, 900])
    scattered, late, early = (ticks + rng.uniform(-x, x, 2000) for x in (0.4, 0.02, 0.02))
    late[500] += 0.6
    early[500] -= 0.6
    for stamps in (scattered, late, early):
        time = 0.01 * stamps[there]
        (episode,) = episodes(_table(time=time, ctrl__motor=ctrl[there], qpos__x=np.sin(time)), ["motor"], RANGES)
        np.testing.assert_array_equal(episode.ctrl[there, 0], ctrl[there])
        assert not episode.notes
        near = np.abs(stamps - ticks) < 0.49  # nobody knows what the others show
        assert np.isfinite(np.broadcast_to(episode.off_tick, 2000)[there & near]).all()
        assert np.isnan(episode.off_tick[500]) == (stamps is not scattered)


def test_a_force_that_was_read_before_its_tick_shows_the_command_before() -> None:
    rng, ticks = np.random.default_rng(0), np.arange(2000) * 0.01
    late = rng.choice([-0.0002, 0.0, 0.0002], 2000)
    ctrl = rng.normal(size=2000)
    force = np.where(late < 0, np.roll(ctrl, 1), ctrl)
    columns = {"time": ticks + late, "ctrl__motor": ctrl, "qpos__x": np.sin(ticks + late), "force__motor": force}
    (episode,) = episodes(_table(**columns), ["motor"], RANGES)
    np.testing.assert_allclose(episode.off_tick, late, atol=2e-6)
    np.testing.assert_array_equal(episode.signals["force/motor"], force)  # not smoothed over the jumps
    gone = np.arange(2000) % 50 != 7
    (holes,) = episodes(_table(**{n: x[gone] for n, x in columns.items()}), ["motor"], RANGES)
    assert np.isnan(holes.off_tick[~gone]).all()  # nobody read it there
    np.testing.assert_allclose(holes.off_tick[gone], late[gone], atol=2e-6)


def test_an_uneven_clock_holds_each_command_from_its_own_time() -> None:
    time = np.cumsum(np.r_[0.0, np.tile([0.008, 0.008, 0.008, 0.016], 100)])
    (episode,) = episodes(_table(time=time, ctrl__motor=np.arange(401.0), qpos__x=np.sin(time)), ["motor"], RANGES)
    held = np.searchsorted(time, time[0] + episode.dt * np.arange(len(episode.ctrl)) + 1e-6, side="right") - 1
    np.testing.assert_array_equal(episode.ctrl[:, 0], held)
    np.testing.assert_array_equal(np.isnan(episode.off_tick), np.arange(len(held)) % 5 == 4)
    time = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.015, 400))
    (episode,) = episodes(_table(time=time, ctrl__motor=np.arange(400.0), qpos__x=np.sin(time)), ["motor"], RANGES)
    assert np.isnan(episode.off_tick).all()
    assert "of the stamps are off an even clock by more than half a sample" in episode.notes[0]


def test_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no episodes in this folder"):
        sources([tmp_path])
    with pytest.raises(UserError, match="no such file"):
        sources([tmp_path / "absent.csv"])
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(UserError, match="unknown ending '.txt'"):
        sources([tmp_path / "notes.txt"])


def test_csv_and_parquet_hold_the_same(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    columns = _table().columns
    write_csv(tmp_path / "a.csv", columns)
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    for name in ("a.csv", "a.parquet"):
        read = read_table(tmp_path / name).columns
        assert list(read) == list(columns)
        for key, values in columns.items():
            np.testing.assert_allclose(read[key], values, atol=1e-9)


def test_a_file_of_several_episodes_is_that_many_files(tmp_path: Path) -> None:
    columns = _table().columns
    count = len(columns["time"])
    both = {name: np.r_[values, 2 * values] for name, values in columns.items()}
    write_csv(tmp_path / "log.csv", {"episode": np.repeat([20250107.0, 3.0], count), **both})
    first, second = (t for t in opened(tmp_path / "log.csv").tables((), ()))
    assert (first.name, second.name) == ("log-20250107", "log-3") and list(first.columns) == list(columns)
    for name, values in columns.items():
        np.testing.assert_allclose(first.columns[name], values, atol=1e-9)
        np.testing.assert_allclose(second.columns[name], 2 * values, atol=1e-9)
    write_csv(tmp_path / "log.csv", {"episode": np.r_[np.zeros(count), np.nan * np.zeros(count)], **both})
    with pytest.raises(UserError, match=f"log: episode is not a number in row {count}"):
        opened(tmp_path / "log.csv").tables((), ())


@pytest.mark.parametrize("text", ["", "time,ctrl/m\n", "time,ctrl/m\n0,1\n0.1\n", "time\nzero\n", "time,a,a\n0,1,2\n"])
def test_broken_csv(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(UserError, match=r"a\.csv"):
        read_table(tmp_path / "a.csv")


def test_a_csv_of_another_alphabet(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("time,größe\n0,1\n".encode("latin-1"))
    with pytest.raises(UserError, match="not a CSV file in UTF-8"):
        read_table(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbftime,ctrl/m\n0,1\n")  # what spreadsheets put first
    assert list(read_table(tmp_path / "b.csv").columns) == ["time", "ctrl/m"]


def test_broken_parquet_and_mcap(tmp_path: Path) -> None:
    for name in ("a.parquet", "a.mcap"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(UserError, match=name):
            read_table(tmp_path / name)


def test_a_truncated_mcap_is_read_as_far_as_it_is_whole(tmp_path: Path) -> None:
    from mpc_sgft.storage.episode_file import EpisodeWriter

    path = tmp_path / "a.mcap"
    with EpisodeWriter(path, {"joint_names": ["x"], "actuator_names": ["motor"]}) as writer:
        for k in range(12):
            t = 0.2 * k + 0.01 * np.arange(20)
            row = {"step": k, "time": t[-1], "observation": [0.0], "action": [0.0], "action_sent": [0.0], "reward": 0.0}
            row |= {"terminated": False, "truncated": False, "success": False}
            joints = {"qpos": np.sin(t)[:, None], "qvel": np.cos(t)[:, None], "ctrl": np.cos(t)[:, None]}
            writer.step(row, {"time": t, **joints})
        writer.close({})
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.6 * len(whole))])
    table = read_table(path)
    assert 50 < len(table.columns["time"]) < 240 and "whole steps kept" in (table.lost or "")
    (episode,) = episodes(table, ["motor"], RANGES)
    assert "whole steps kept" in episode.notes[0]


@pytest.mark.parametrize(("backend", "late"), [({}, 1), ({"backend": "franka"}, 0)])
def test_commands_of_the_simulators_record_act_before_their_time(backend: dict, late: int, tmp_path: Path) -> None:
    from mpc_sgft.storage.episode_file import EpisodeWriter

    path, t = tmp_path / "a.mcap", 0.01 * np.arange(1, 21)
    row = {"step": 0, "time": t[-1], "observation": [0.0], "action": [0.0], "action_sent": [0.0], "reward": 0.0}
    row |= {"terminated": False, "truncated": False, "success": False}
    with EpisodeWriter(path, {"joint_names": ["x"], "actuator_names": ["m"], **backend}) as writer:
        writer.step(row, {"time": t} | {kind: t[:, None] for kind in ("qpos", "qvel", "ctrl", "force")})
        writer.close({})
    table = read_table(path)
    np.testing.assert_allclose(table.columns["time"], t[: 20 - late])
    for column, first in (("qpos/x", 0), ("qvel/x", 0), ("ctrl/m", late), ("force/m", late)):
        np.testing.assert_allclose(table.columns[column], t[first : first + 20 - late])
    assert len(table.notes) == late


def test_models_that_do_not_load(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such model file"):
        load_plant(tmp_path / "absent.xml")
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(UserError, match="MuJoCo cannot load this scene"):
        load_plant(tmp_path / "broken.xml")
    (tmp_path / "still.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(UserError, match="the model has no joint"):
        load_plant(tmp_path / "still.xml")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("--window -1", "--window -1: the length of a simulated window is a number above 0"),
        ("--window nan", "a number above 0"),
        ("--window 100", "--window 100 does not fit these episodes: from 0.04 s"),
        ("--window 0.001", "does not fit"),
        ("--seed -1", "--seed -1: a whole number from 0 on"),
        ("--max-effects 0", "at least one effect"),
        ("--held-out 2", "held-out share 2.0"),
        ("--held-out run7", "held-out episode 'run7' is not in the data"),
        ("--signals qpos/y", "signal 'qpos/y' is not in every episode"),
        ("--signals sensor/current", "the scene has no sensor of that name"),
        ("--effects friction", "unknown effect 'friction'"),
        ("--uncertain colour=0.1", "colour"),
    ],
)
def test_settings_that_cannot_be(
    args: str, words: str, slide: Path, moved: Callable, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    columns = moved(1.0)
    write_csv(tmp_path / "a.csv", columns | {"sensor/current": columns["ctrl/motor"]})
    answer = main(["--model", str(slide), "--data", str(tmp_path / "a.csv"), "--out", str(tmp_path), *args.split()])
    assert answer == 2 and words in capsys.readouterr().err


def test_the_command_line_answers_and_refuses(command: Callable, slide: Path, tmp_path: Path) -> None:
    answer = command("diagnose", "--help")
    assert answer.returncode == 0 and "--held-out" in answer.stdout
    for args, words in (
        ((), "--model is missing"),
        (("--model", str(slide), "--data", str(tmp_path / "absent")), "no such file or folder"),
        (("--model", str(slide), "--data", str(tmp_path), "--uncertain", "mass"), "quantity=share"),
    ):
        answer = command("diagnose", *args)
        assert answer.returncode == 2 and words in answer.stderr, answer.stderr
        assert "Traceback" not in answer.stderr
