import resource
import subprocess
import sys
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from mpc_sgft.command.errors import UserError
from mpc_sgft.views.blueprint import Layout, camera
from mpc_sgft.views.episode_view import Candidates, EpisodeView
from mpc_sgft.views.robot_view import triangles
from mpc_sgft.views.value_image import viridis
from mpc_sgft.views.viewer import RunViewer
from tools.screenshot import open_viewer, reports, set_time

ROOT = Path(__file__).parents[3]
ARM = """
<mujoco>
  <worldbody>
    <geom name="table" type="plane" size=".6 .4 .1" rgba=".8 .7 .6 1"/>
    <geom name="goal" type="box" size=".02 .3 .001" pos=".4 0 .001" rgba=".2 .6 .3 1" contype="0" conaffinity="0"/>
    <body name="upper" pos="0 0 .3">
      <joint name="a" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <body name="lower" pos=".3 0 0">
        <joint name="b" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/>
        <body pos=".2 0 0"><geom type="sphere" size=".03" rgba=".2 .4 .8 1"/></body>
      </body>
    </body>
    <body name="puck" pos=".2 0 .02">
      <freejoint/>
      <geom type="cylinder" size=".03 .02" rgba=".8 .2 .2 1"/>
    </body>
  </worldbody>
</mujoco>
"""
T, H, N = 6, 4, 20


@pytest.fixture
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def episode(model: mujoco.MjModel | None = None, seed: int = 0, **changes) -> EpisodeView:
    rng = np.random.default_rng(seed)
    ee = np.cumsum(rng.normal(size=(T + 1, 3)) * 0.02, 0) + [0.2, 0, 0.05]
    puck = ee + [0.05, 0, 0]
    qpos = None
    if model is not None:
        qpos = np.tile(model.qpos0, (T + 1, 1))
        qpos[:, :2] = rng.normal(size=(T + 1, 2)) * 0.2
    ahead = np.minimum(np.arange(T)[:, None] + np.arange(H + 1), T)
    paths = ee[2] + np.cumsum(rng.normal(size=(N, H + 1, 3)) * 0.01, 1)
    view = EpisodeView(
        title="first try",
        ee=ee,
        qpos=qpos,
        object=puck,
        imagined_ee=ee[ahead] + 0.001,
        imagined_object=puck[ahead] + 0.001,
        candidates=[Candidates(2, paths, rng.normal(size=N))],
        reward=np.arange(T) * 0.1,
        predicted_return=rng.normal(size=T),
        real_return=rng.normal(size=T),
        model_error=np.abs(rng.normal(size=(T, H))),
        plan_ms=np.full(T, 21.0),
        success=True,
    )
    return view._replace(**changes)


def write(path, model, episodes: int = 2) -> None:
    with RunViewer(path, model, control_dt=0.2, layout=Layout(metrics=("success",))) as viewer:
        grid = np.add.outer(np.linspace(-1, 0, 12), np.linspace(0, 1, 9))
        viewer.value_map("before", grid, (-0.1, 0.5, -0.3, 0.3), marks={"puck": (0.2, 0.1)})
        viewer.metrics(viewer.env_step, {"success": 0.2})
        for k in range(episodes):
            viewer.episode(episode(model, seed=k, success=k == 1))
            viewer.metrics(viewer.env_step, {"success": 0.2 + 0.3 * k})
        viewer.value_map("after", grid + 0.2, (-0.1, 0.5, -0.3, 0.3), limits=(-1, 1.2))


def columns(path) -> dict[str, dict[str, list]]:
    """Entity -> component -> values in the order of the file, and its `env_step`s where it is not static."""
    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        entity = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            entity.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def test_everything_is_in_the_file(tmp_path, arm):
    write(tmp_path / "run.rrd", arm)
    found = columns(tmp_path / "run.rrd")
    both = 2 * (T + 1)
    upper = found["/world/robot/bodies/upper"]
    assert sorted(set(upper["env_step"])) == list(range(both)) and set(upper["episode"]) == {0, 1}
    for part in ("ee", "object"):
        strips = found[f"/world/imagined/{part}"]["LineStrips3D:strips"]
        assert [len(row) for row in strips] == ([1] * T + [0]) * 2  # nothing is imagined from the last state
        assert len(strips[0][0]) == H + 1
        assert [len(row) for row in found[f"/world/trail/{part}"]["LineStrips3D:strips"]] == list(range(T + 1)) * 2
        assert Counter(found[f"/world/ghost/{part}"]["env_step"]) == Counter(range(both))  # T poses and a Clear
    assert "/world/object" not in found  # the model has one
    rows = found["/world/candidates"]
    assert sorted(zip(rows["env_step"], map(len, rows["LineStrips3D:strips"]), strict=True))[:3] == [
        (2, N),
        (3, 0),
        (T, 0),
    ]
    real = episode(arm, seed=0).real_return
    assert np.allclose(np.ravel(found["/returns/real"]["Scalars:scalars"])[:T], real)
    assert np.ravel(found["/reward/reward"]["Scalars:scalars"])[:T] == pytest.approx(np.arange(T) * 0.1)
    assert all(len(found[f"/model_error/h{h}"]["env_step"]) == both for h in range(1, H + 1))
    assert found["/planner/plan_ms"]["Scalars:scalars"][0] == [21.0]
    assert found["/success"]["Scalars:scalars"] == [[0.0], [1.0]]
    assert found["/metrics/success"]["env_step"] == [0, T + 1, both]
    assert found["/episodes"]["TextLog:text"][1] == ["1: success, 6 steps, return 1.50. first try"]
    assert found["/episodes"]["env_step"] == [T, both - 1]
    for name in ("before", "after"):
        assert found[f"/value_map/{name}"]["Image:buffer"]
    shapes = [entity for entity in found if "visual_geometries" in entity]
    assert len(shapes) == arm.ngeom  # the plane and the colliding table top beside the goal included
    assert len(RrdReader(tmp_path / "run.rrd").blueprints()) == 1


def test_a_bounded_file_draws_fewer_and_fewer_episodes_and_tells_of_all(tmp_path, arm):
    write(tmp_path / "one.rrd", arm, episodes=1)
    write(tmp_path / "two.rrd", arm, episodes=2)
    one, two = ((tmp_path / name).stat().st_size for name in ("one.rrd", "two.rrd"))
    limit, path = one + 16 * (two - one), tmp_path / "run.rrd"
    with RunViewer(path, arm, control_dt=0.2, limit=limit) as viewer:
        for k in range(60):
            viewer.episode(episode(arm, seed=k))
    found = columns(path)
    drawn = sorted(set(found["/world/trail/ee"]["episode"]))
    steps = np.diff(drawn)
    assert drawn[:7] == [0, 1, 2, 3, 4, 5, 6] and (np.diff(steps) >= 0).all() and {1, 2, 4} <= set(steps)
    assert len(found["/episodes"]["env_step"]) == len(found["/success"]["env_step"]) == 60
    assert "log.rerun_mb" in found["/episodes"]["TextLog:text"][59][0]
    told = 60 * 4000  # [bytes] the line of each episode, and the file's own index of it
    assert 0.7 * limit < path.stat().st_size < limit + told


def test_the_robot_stands_where_mujoco_says(tmp_path, arm):
    data = mujoco.MjData(arm)
    view = episode(arm)
    with RunViewer(tmp_path / "run.rrd", arm, control_dt=0.2) as viewer:
        viewer.episode(view)
    lower = columns(tmp_path / "run.rrd")["/world/robot/bodies/lower"]
    assert view.qpos is not None
    for row, q in enumerate(view.qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(arm, data)
        index = len(lower["env_step"]) - 1 - lower["env_step"][::-1].index(row)
        assert np.allclose(lower["Transform3D:translation"][index][0], data.body("lower").xpos, atol=1e-6)
        x, y, z, w = lower["Transform3D:quaternion"][index][0]
        assert np.allclose([w, x, y, z], data.body("lower").xquat, atol=1e-6)


@pytest.mark.parametrize(
    "kind, faces", [('type="grid" dim="2" count="3 3 1"', 8), ('type="grid" dim="3" count="2 2 2"', 12)]
)
def test_what_is_soft_is_drawn_as_it_bends(tmp_path, kind, faces):
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><flexcomp name="soft" {kind} spacing=".1 .1 .1" radius=".01"/></worldbody></mujoco>'
    )
    qpos = np.random.default_rng(0).normal(size=(T + 1, model.nq)) * 0.02
    view = episode(model=None, object=None, imagined_object=None, qpos=qpos, candidates=())
    with RunViewer(tmp_path / "run.rrd", model, control_dt=0.05, layout=Layout(value_maps=())) as viewer:
        viewer.episode(view)
    soft, data = columns(tmp_path / "run.rrd")["/world/robot/flexes/soft"], mujoco.MjData(model)
    drawn = [v for v in soft["Mesh3D:vertex_positions"] if v]
    assert len(drawn) == T + 1
    for q, vertices in zip(qpos, drawn, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        assert np.allclose(vertices, data.flexvert_xpos, atol=1e-6)
    assert triangles(model, 0).shape == (faces, 3) and triangles(model, 0).max() == model.nflexvert - 1


def test_the_ghost_is_what_was_imagined_one_step_before(tmp_path):
    view = episode()
    with RunViewer(tmp_path / "run.rrd", None, control_dt=0.2) as viewer:
        viewer.episode(view)
    ghost = columns(tmp_path / "run.rrd")["/world/ghost/ee"]
    centres = [c for c in ghost["Ellipsoids3D:centers"] if c]
    assert view.imagined_ee is not None
    assert np.allclose(np.squeeze(centres, 1), view.imagined_ee[:, 1], atol=1e-6)


def test_a_pendulum_needs_no_object_and_no_value_maps(tmp_path):
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="rod"><joint axis="0 1 0"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/></body></worldbody></mujoco>'
    )
    view = episode(model=None, object=None, imagined_object=None, qpos=np.zeros((T + 1, 1)), candidates=())
    with RunViewer(tmp_path / "run.rrd", model, control_dt=0.05, layout=Layout(value_maps=())) as viewer:
        viewer.episode(view)
        with pytest.raises(ValueError, match="value map 'before'"):
            viewer.value_map("before", np.zeros((2, 2)), (0, 1, 0, 1))
    found = columns(tmp_path / "run.rrd")
    assert "/world/robot/bodies/rod" in found and "/world/imagined/ee" in found
    assert not [entity for entity in found if entity.endswith("object")]


def test_without_a_model_the_object_is_drawn(tmp_path):
    layout = Layout(object_in_model=False, object_radius=0.04)
    with RunViewer(tmp_path / "run.rrd", None, control_dt=0.2, layout=layout) as viewer:
        viewer.episode(episode())
    cylinder = columns(tmp_path / "run.rrd")["/world/object"]
    assert np.allclose(np.squeeze(cylinder["Cylinders3D:centers"], 1), episode().object, atol=1e-6)
    assert np.allclose(cylinder["Cylinders3D:radii"], 0.04)


def test_wrong_shapes_are_named_and_nothing_is_written(tmp_path, arm):
    with RunViewer(tmp_path / "run.rrd", arm, control_dt=0.2) as viewer:
        for name, array in (
            ("object", np.zeros((T, 3))),
            ("imagined_object", np.zeros((T, H, 3))),
            ("model_error", np.zeros(T)),
            ("plan_ms", np.zeros(T + 1)),
            ("qpos", np.zeros((T, 9))),
        ):
            with pytest.raises(ValueError, match=f"EpisodeView.{name} "):
                viewer.episode(episode(arm, **{name: array}))
        with pytest.raises(ValueError, match="qpos must be"):
            viewer.episode(episode(arm, qpos=np.zeros((T + 1, 3))))
        with pytest.raises(ValueError, match="Candidates"):
            viewer.episode(episode(arm, candidates=[Candidates(T, np.zeros((N, H + 1, 3)), np.zeros(N))]))
        with pytest.raises(ValueError, match="finite"):
            viewer.value_map("before", np.full((2, 2), np.nan), (0, 1, 0, 1))
        assert viewer.env_step == 0
    assert not [entity for entity in columns(tmp_path / "run.rrd") if entity.startswith("/world/imagined")]
    with RunViewer(tmp_path / "none.rrd", None, control_dt=0.2) as viewer, pytest.raises(ValueError, match="no model"):
        viewer.episode(episode(arm))


def test_an_existing_file_is_not_overwritten(tmp_path):
    (tmp_path / "run.rrd").write_text("earlier")
    with pytest.raises(FileExistsError, match="run.rrd"):
        RunViewer(tmp_path / "run.rrd", None, control_dt=0.2)
    assert (tmp_path / "run.rrd").read_text() == "earlier"
    with pytest.raises(FileNotFoundError, match="nowhere"):
        RunViewer(tmp_path / "nowhere" / "run.rrd", None, control_dt=0.2)


def test_a_full_disk_is_an_error_with_the_path(tmp_path):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    viewer = RunViewer(tmp_path / "run.rrd", None, control_dt=0.2)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "run.rrd").stat().st_size + 5000, limit[1]))
    try:
        with pytest.raises(OSError, match="run.rrd"):
            for k in range(20):
                viewer.episode(episode(seed=k))
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limit[1]))
        with pytest.raises(OSError, match="run.rrd'"):  # the place of temporary files is as full
            RunViewer(tmp_path / "run.rrd", None, control_dt=0.2, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)


KILLED = """
import os, signal, sys
import mujoco
from tests.mpc_sgft.views.test_viewer import ARM, RunViewer, episode
model = mujoco.MjModel.from_xml_string(ARM)
viewer = RunViewer(sys.argv[1], model, control_dt=0.2)
for k in range(2):
    viewer.episode(episode(model, seed=k))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("torn", [0, 5, 3000])
def test_a_killed_run_is_resumed_in_the_same_file(tmp_path, arm, torn):
    path = tmp_path / "run.rrd"
    subprocess.run([sys.executable, "-c", KILLED, str(path)], cwd=ROOT, check=False)
    if torn:  # the kill came while a frame was being written
        path.write_bytes(path.read_bytes() + (b"\x02" + bytes(7) + b"\xff\xff" + bytes(6) + bytes(5000))[:torn])
    with RunViewer(path, arm, control_dt=0.2, resume=True) as viewer:
        assert viewer.env_step == 2 * (T + 1)
        viewer.episode(episode(arm, seed=2))
    found = columns(path)
    assert [text[0][0] for text in found["/episodes"]["TextLog:text"]] == ["0", "1", "2"]
    assert set(found["/world/robot/bodies/upper"]["env_step"]) == set(range(3 * (T + 1)))
    assert sorted(found["/returns/real"]["env_step"]) == list(range(3 * (T + 1)))
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("left", [None, 0, 7, 12])
def test_resume_without_anything_to_take_over_starts_a_file(tmp_path, left):
    if left is not None:
        (tmp_path / "run.rrd").write_bytes(b"RRF2" + bytes(20)[: left - 4] if left >= 4 else b"")
    with RunViewer(tmp_path / "run.rrd", None, control_dt=0.2, resume=True) as viewer:
        viewer.episode(episode())
    assert len(columns(tmp_path / "run.rrd")["/episodes"]["env_step"]) == 1


def test_resume_of_a_file_that_is_no_recording_says_so_and_keeps_it(tmp_path):
    (tmp_path / "run.rrd").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(UserError, match="no rerun recording.*Move it away"):
        RunViewer(tmp_path / "run.rrd", None, control_dt=0.2, resume=True)
    assert (tmp_path / "run.rrd").read_bytes() == bytes(range(256)) * 20


@pytest.mark.parametrize(("begin", "says"), [(12, "damaged: only zeros at byte 12"), (28, r"damaged \(.* run.rrd: ")])
def test_resume_of_a_file_with_a_hole_names_the_file_and_keeps_it(tmp_path, begin, says):
    """A power loss may leave zeros in the middle: where a frame begins, or in one."""
    with RunViewer(tmp_path / "run.rrd", None, control_dt=0.2) as viewer:
        viewer.episode(episode())
    data = (tmp_path / "run.rrd").read_bytes()
    (tmp_path / "run.rrd").write_bytes(data[:begin] + bytes(30) + data[begin + 30 :])
    with pytest.raises(UserError, match=f"^{tmp_path / 'run.rrd'} is {says}.*Move it away"):
        RunViewer(tmp_path / "run.rrd", None, control_dt=0.2, resume=True)
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]


def test_colours_go_from_dark_to_light():
    colours = viridis(np.linspace(-0.1, 1.1, 50)).astype(float)
    assert (np.diff(colours @ [0.2, 0.7, 0.1]) >= 0).all() and tuple(colours[-1]) == (253, 231, 37)


def test_the_camera_sees_the_whole_model_unless_told_otherwise(arm):
    eye, target = camera(arm, Layout())
    assert np.allclose(target, arm.stat.center)
    assert arm.stat.extent < np.linalg.norm(np.subtract(eye, target)) < 3 * arm.stat.extent
    assert camera(arm, Layout(eye=(1, 2, 3), target=(0, 0, 1))) == ((1, 2, 3), (0, 0, 1))


def test_an_episode_costs_milliseconds(tmp_path, arm):
    import time

    with RunViewer(tmp_path / "run.rrd", arm, control_dt=0.2) as viewer:
        start = time.perf_counter()
        for k in range(5):
            viewer.episode(episode(arm, seed=k))
        assert (time.perf_counter() - start) / 5 < 0.5  # measured 0.02 s for 40 steps and 20 times 256 candidates


def test_the_viewer_warns_about_nothing(viewer_draws, tmp_path, arm):
    """Opens the file in the real viewer, without a screen, and walks through it."""
    write(tmp_path / "run.rrd", arm)
    with open_viewer(tmp_path / "run.rrd") as client:
        for step in (2, T, 2 * T):
            set_time(client, "env_step", str(step))
            client.save_screenshot(str(tmp_path / "shot.png"))  # so that every view has been drawn
            assert reports(client) == []
        views = client.get_state().views
        logged = set(client.get_recording_schema().timelines[i].name for i in range(2))
    assert Counter(view.view_class for view in views) == {
        "3D": 2, "2D": 2, "TimeSeries": 5, "TextLog": 1
    }  # fmt: skip
    assert all(view.visible for view in views)
    assert logged == {"env_step", "episode"}
