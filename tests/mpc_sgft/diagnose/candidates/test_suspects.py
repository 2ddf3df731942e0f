"""Where fits start, of what may be missing in a task's simulation."""

import numpy as np
import pytest
from hydra.utils import instantiate

from mpc_sgft.command.compose import compose
from mpc_sgft.diagnose.candidates.suspects import suspects


@pytest.mark.parametrize(("name", "count"), [("push", 4), ("insert", 8), ("walker_walk", 2)])
def test_fits_of_a_drift_start_with_every_sign_unless_there_are_too_many(name: str, count: int) -> None:
    task = instantiate(compose("deploy", [f"task={name}"], []).task.env, _convert_="all")
    (drift,) = suspects(task, ["actuator_offset"])
    assert len(drift.starts) == len({tuple(np.sign(s)) for s in drift.starts}) == count
