"""Nothing leaves the limits: a hundred thousand random and adversarial moves, and each limit alone by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.backends.limits import Limits
from envs.backends.safety import Gate, NotSafe, Retries, doubt, unseen
from envs.fr3 import DQ_MAX, Q_MAX, Q_MIN
from envs.kinematics import chain, tip_position

LIMITS = {
    "low": (0.14, -0.36, -0.195),
    "high": (0.82, 0.36, 0.10),
    "body_height": 0.06,
    "joint_margin": 0.1,
    "speed": 0.4,
    "step": 0.1,
    "state_age": 0.1,
    "detection_age": 0.25,
    "retries": 2,
}
TOOL, DT, SAMPLES = 0.15, 0.008, 25
LIMIT = Limits(**LIMITS)
GATE = Gate(LIMIT, tool_length=TOOL, sample_dt=DT)
INSIDE = np.array([0.0, 0.35, 0.0, -2.3, 0.0, 2.65, 0.785])
ROWS = 500  # cases an example


def assert_inside(path: np.ndarray, start: np.ndarray) -> None:
    """The limits again, written without the gate's own code, for path [N, S, 7] and start [N, 7]."""
    flat = path.reshape(-1, 7)
    assert np.isfinite(flat).all()
    assert (flat >= Q_MIN + 0.1).all() and (flat <= Q_MAX - 0.1).all()
    tip = tip_position(flat, TOOL).reshape(*path.shape[:2], 3)
    assert (tip >= LIMIT.low).all() and (tip <= LIMIT.high).all()
    assert (chain(flat, TOOL)[0][:, 2:, 2] >= LIMIT.low[2] + 0.06).all()
    assert (np.linalg.norm(tip - tip_position(start, TOOL)[:, None], axis=2) <= LIMIT.step).all()
    pace = np.abs(np.diff(np.concatenate([start[:, None], path], 1), axis=1)) / DT
    assert (pace <= LIMIT.speed * DQ_MAX + 1e-9).all()


def starts(rng: np.random.Generator) -> np.ndarray:
    """Allowed postures [ROWS, 7], many of them close to a limit: a chain of moves that the gate itself cut."""
    q = np.repeat(INSIDE[None], ROWS, 0)
    for _ in range(2):
        q = GATE.step(q, q + rng.normal(0, 0.4, q.shape), 5).path[:, -1]
    return q


@settings(max_examples=200, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32), kind=st.sampled_from(["near", "far", "huge", "tiny", "still", "edges", "drilled"]))
def test_no_target_ever_leaves_the_limits(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    start = starts(rng)
    moves = {
        "near": lambda: start + rng.normal(0, 0.05, start.shape),
        "far": lambda: start + rng.normal(0, 1.0, start.shape),
        "huge": lambda: rng.choice([-1e308, 1e308, 1e30, -1e30], start.shape),
        "tiny": lambda: start + rng.choice([5e-324, -5e-324, 1e-300, 1e-17], start.shape),
        "still": lambda: start.copy(),
        "edges": lambda: rng.choice(np.stack([Q_MIN, Q_MAX, Q_MIN + 0.1, Q_MAX - 0.1]), axis=0) * np.ones_like(start),
        "drilled": lambda: start + rng.choice([-0.3, 0, 0.3], start.shape) * rng.integers(0, 2, start.shape),
    }
    step = GATE.step(start, moves[kind](), SAMPLES)
    assert_inside(step.path, start)
    assert ((step.share >= 0) & (step.share <= 1)).all()
    assert all(bool(note) == (share < 1) for note, share in zip(step.note, step.share, strict=True))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(q=st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), min_size=7, max_size=7))
def test_any_seven_numbers_are_refused_or_cut(q: list[float]) -> None:
    goal = np.array([q])
    if not np.isfinite(goal).all():
        with pytest.raises(NotSafe, match="not finite"):
            GATE.step(INSIDE[None], goal, SAMPLES)
        return
    assert_inside(GATE.step(INSIDE[None], goal, SAMPLES).path, INSIDE[None])
    try:
        GATE.step(goal, INSIDE[None], SAMPLES)
    except NotSafe:
        return
    assert_inside(goal[None], goal)


def test_a_small_move_inside_goes_through_whole() -> None:
    goal = INSIDE[None] + 0.01
    step = GATE.step(INSIDE[None], goal, SAMPLES)
    assert step.share[0] == 1 and step.note == [""]
    np.testing.assert_allclose(step.path[0, -1], goal[0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [({"step": 0.005}, "step size"), ({"speed": 0.01}, "joint speed"), ({"body_height": 0.6}, "outside its limits")],
)
def test_each_limit_says_its_name(change: dict, reason: str) -> None:
    gate = Gate(Limits(**{**LIMITS, **change}), tool_length=TOOL, sample_dt=DT)
    try:
        said = gate.step(INSIDE[None], INSIDE[None] + 0.05, SAMPLES).note[0]
    except NotSafe as error:
        said = str(error)
    assert reason in said


def test_a_joint_near_its_end_is_stopped_before_it() -> None:
    start = INSIDE.copy()
    start[6] = Q_MAX[6] - 0.12
    step = GATE.step(start[None], start[None] + [0, 0, 0, 0, 0, 0, 0.3], SAMPLES)
    assert step.note == ["joint range"] and 0 < step.share[0] < 1
    assert step.path[0, -1, 6] <= Q_MAX[6] - 0.1


def test_a_route_is_taken_whole_or_not_at_all() -> None:
    path = INSIDE + np.linspace(0, 0.05, 50)[:, None]
    assert GATE.route(path) is path
    with pytest.raises(NotSafe, match="joint speed"):
        GATE.route(path[[0, -1]] * [[1], [1.0]] + [[0] * 7, [0.05] * 7])
    high = INSIDE + np.linspace(0, 1, 400)[:, None] * [0, -0.3, 0, 0, 0, 0, 0]
    with pytest.raises(NotSafe, match="workspace box"):
        GATE.route(high)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"low": (0.9, -0.36, -0.195)}, "inside out along x"),
        ({"high": (0.82, 0.36, float("nan"))}, "inside out along z"),
        ({"joint_margin": 3.0}, "joint_margin"),
        ({"speed": 0.0}, "speed"),
        ({"step": -1.0}, "step"),
        ({"retries": -1}, "retries"),
        ({"body_height": -1.0}, "body_height"),
        ({"body_height": float("nan")}, "body_height"),
    ],
)
def test_limits_that_make_no_sense_are_refused(change: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Limits(**{**LIMITS, **change})


def calm() -> dict:
    q = INSIDE.copy()
    return {"state_age": 0.0, "mode": "Move", "q": q, "told": q, "dq": np.zeros(7), "tip": np.array([0.5, 0, 0])}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, ""),
        ({"mode": "UserStopped"}, "stop button"),
        ({"mode": "Reflex"}, "reflex"),
        ({"mode": "Guiding"}, "Guiding"),
        ({"state_age": 0.2}, "no news"),
        ({"state_age": float("nan")}, "no news"),
        ({"dq": np.full(7, np.nan)}, "not finite"),
        ({"dq": np.array([2.6, 0, 0, 0, 0, 0, 0])}, "joint 1 is too fast"),
        ({"told": INSIDE + [0, 0, 0, 0.4, 0, 0, 0]}, "joint 4 is not where"),
        ({"q": np.r_[INSIDE[:6], 3.0], "told": np.r_[INSIDE[:6], 3.0]}, "joint 7 is at the end"),
        ({"tip": np.array([0.5, 0, -0.3])}, "pushed out"),
    ],
)
def test_doubts(change: dict, words: str) -> None:
    said = doubt(LIMIT, **{**calm(), **change})
    assert (words in said) if words else said == ""


def test_a_sight_that_is_old_missing_or_from_the_future_does_not_count() -> None:
    assert unseen(LIMIT, 0.1) == ""
    assert all(unseen(LIMIT, age) for age in (None, 0.3, -0.1, float("nan")))


def test_faults_in_a_row_end_the_session() -> None:
    retries = Retries(2)
    retries.failed("a")
    retries.failed("b")
    with pytest.raises(NotSafe, match="3 faults in a row, the last: c"):
        retries.failed("c")
    retries.succeeded()
    retries.failed("d")
