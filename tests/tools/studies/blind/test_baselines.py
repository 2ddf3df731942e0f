"""The simpler ways to name find what a linear regression can find."""

from pathlib import Path

import numpy as np

from tools.studies.blind import baselines
from tools.studies.blind.loop import simulate, start
from tools.studies.blind.mjcf import build
from tools.studies.blind.plants import PLANTS
from tools.studies.blind.truths import rows

NUMBERS = {"m": 4.0, "armature": [1.0], "damping": [3.0], "dry": [0.0], "gear": [20.0], "limit": [200.0]}


def write_case(folder: Path, **change: float) -> Path:
    """Two seconds of a slide under a multisine of forces, with an exact encoder."""
    plant, ticks = PLANTS["slide"], 1000
    t = np.arange(ticks) * 0.002
    u = (1.5 * np.cos(2 * np.pi * 0.8 * t) + np.cos(2 * np.pi * 2.1 * t))[None, :, None]
    p = rows(plant, NUMBERS)
    for name, value in change.items():
        p[name][:] += value
    record = simulate(plant, p, start(np.zeros((1, 1)), np.zeros((1, 1))), ticks, 10, commands=u)
    table = np.column_stack([record.time[0], u[0, :, 0], record.qpos[0, :, 0]])
    np.savetxt(folder / "episode_0.csv", table, delimiter=",", header="time,ctrl/motor,qpos/slide", comments="")
    (folder / "model.xml").write_text(build(plant, NUMBERS))
    (folder / "known.json").write_text('{"uncertain": {}}')
    return folder


def test_sparse_regression_keeps_the_columns_that_matter() -> None:
    rng = np.random.default_rng(0)
    a = rng.standard_normal((500, 5))
    y = 2 * a[:, 1] - 3 * a[:, 4] + 0.01 * rng.standard_normal(500)
    assert baselines.sparse(a, y, 0.1, 1e-3).tolist() == [False, True, False, False, True]


def test_the_residual_names_what_was_put_in(tmp_path: Path) -> None:
    found = baselines.run(write_case(tmp_path, quad=8.0))
    assert found["training_error"]["effects"][0]["name"] == "quadratic_drag"
    assert "quadratic_drag" in [e["name"] for e in found["bic"]["effects"]]
    assert found["training_error"]["held_out_ratio"] < 0.2
    assert found["always_viscous"]["effects"] == [{"name": "viscous_friction", "at": ["slide"], "parameters": {}}]
    assert found["network"]["verdict"] == "unknown"
    assert set(found) == set(baselines.NAMES)
