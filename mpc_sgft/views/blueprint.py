"""How a run is laid out in the rerun viewer: the scene large on the left, the numbers on the right."""

from typing import NamedTuple

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mpc_sgft.views.value_image import BACKGROUND, CANVAS

WITHOUT_ROBOT = ["+ /world/**", "- /world/robot/**"]
GRID = (255, 255, 255, 26)

Point = tuple[float, float, float]


class Layout(NamedTuple):
    """What the blueprint has to know about a task.

    Attributes:
        eye: Where the camera stands, [m]; None: from the model's extent.
        target: What it looks at, [m]; None: the model's centre.
        second_eye: The same of the view that shows paths without the robot, [m]; None: from above.
        second_target: What it looks at, [m]; None: target.
        object_radius: Of the object's ghost, a cylinder, [m].
        object_height: Of the same, [m].
        object_in_model: Whether the model's qpos moves the object; if not, it is drawn from EpisodeView.object.
        ee_radius: Of the end effector's ghost, a ball, [m].
        value_maps: Names given to RunViewer.value_map, in the order in which they are shown; () for no such views.
        value_label: What the colours of a value map mean.
        metrics: Names given to RunViewer.metrics that get a view of their own, together; () for none.
    """

    eye: Point | None = None
    target: Point | None = None
    second_eye: Point | None = None
    second_target: Point | None = None
    object_radius: float = 0.03
    object_height: float = 0.02
    object_in_model: bool = True
    ee_radius: float = 0.012
    value_maps: tuple[str, ...] = ("before", "after")
    value_label: str = "V(x, y)"
    metrics: tuple[str, ...] = ()


def camera(model: mujoco.MjModel | None, layout: Layout) -> tuple[Point, Point]:
    """Eye and target [m]: as the layout says, else a view from the front and the side that shows the whole model."""
    centre, extent = _size(model)
    target = centre if layout.target is None else layout.target
    return _or_at(layout.eye, target, 1.1 * extent * np.array([0.9, -1.0, 0.6])), _point(target)


def second_camera(model: mujoco.MjModel | None, layout: Layout) -> tuple[Point, Point]:
    """Eye and target [m] of the view without the robot: as the layout says, else from above onto the first target."""
    _, target = camera(model, layout)
    target = target if layout.second_target is None else layout.second_target
    return _or_at(layout.second_eye, target, np.array([0.0, 0.0, 0.6 * _size(model)[1]])), _point(target)


def _size(model: mujoco.MjModel | None) -> tuple[np.ndarray, float]:
    return (np.zeros(3), 1.0) if model is None else (model.stat.center, float(model.stat.extent))


def _or_at(eye: Point | None, target: Point | np.ndarray, offset: np.ndarray) -> Point:
    return _point(np.asarray(target) + offset if eye is None else eye)


def _point(values: Point | np.ndarray) -> Point:
    x, y, z = (float(v) for v in values)
    return x, y, z


def blueprint(model: mujoco.MjModel | None, layout: Layout, control_dt: float) -> rrb.Blueprint:
    """The embedded blueprint of a run.

    Args:
        model: To find a camera that suits it; None if there is none.
        layout: What the task needs.
        control_dt: [s] a step; sets the playback to real time.
    """
    scene = _scene("Robot, object and what the model imagined", camera(model, layout), ground=_ground(model))
    second = _scene("Way so far, plans, imagination", second_camera(model, layout), contents=WITHOUT_ROBOT)
    below: list[rrb.View | rrb.Container] = [second]
    below += [
        rrb.Spatial2DView(
            origin=f"/value_map/{name}",
            name=f"{layout.value_label} {name}",
            background=BACKGROUND,
            visual_bounds=rrb.VisualBounds2D(x_range=(0, CANVAS[0]), y_range=(0, CANVAS[1])),
        )
        for name in layout.value_maps
    ]
    left = rrb.Vertical(scene, rrb.Horizontal(*below), row_shares=[7, 3])
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"], timeline_columns=[])
    right: list[rrb.View | rrb.Container] = [
        _plot("returns", "Return to go: predicted and real"),
        _plot("model_error", "Model error by imagined step"),
        rrb.Horizontal(_plot("reward", "Reward"), _plot("planner", "Planner [ms]")),
        rrb.TextLogView(origin="/episodes", name="Episodes", columns=columns),
    ]
    if layout.metrics:
        right.insert(0, _plot("metrics", "Evaluation", [f"+ /metrics/{name}" for name in layout.metrics]))
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right), column_shares=[13, 7]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="env_step", fps=1.0 / control_dt),
        auto_layout=False,
        auto_views=False,
    )


def _scene(
    name: str,
    eye_and_target: tuple[Point, Point],
    *,
    contents: list[str] | str = "$origin/**",
    ground: rr.components.Plane3D | None = None,
) -> rrb.Spatial3DView:
    eye, target = eye_and_target
    from_above = np.hypot(eye[0] - target[0], eye[1] - target[1]) < 1e-3
    grid = rrb.LineGrid3D(visible=ground is not None, spacing=0.1, stroke_width=1.0, color=GRID, plane=ground)
    return rrb.Spatial3DView(
        origin="/world",
        name=name,
        contents=contents,
        background=BACKGROUND,
        line_grid=grid,
        eye_controls=rrb.EyeControls3D(
            position=eye, look_target=target, eye_up=(0.0, 1.0, 0.0) if from_above else (0.0, 0.0, 1.0)
        ),
    )


def _ground(model: mujoco.MjModel | None) -> rr.components.Plane3D:
    """A level plane a little below the lowest plane of the model, where a grid disturbs nothing."""
    height = 0.0
    if model is not None:
        planes = model.geom_pos[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, 2]
        height = float(planes.min(initial=0.0))
    return rr.components.Plane3D((0.0, 0.0, 1.0), height - 0.02)


def _plot(origin: str, name: str, contents: list[str] | None = None) -> rrb.TimeSeriesView:
    corner = rrb.Corner2D.LeftTop
    return rrb.TimeSeriesView(
        origin=f"/{origin}", name=name, contents=contents or "$origin/**", plot_legend=rrb.PlotLegend(corner)
    )
