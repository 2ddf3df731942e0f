"""Where fits start, of what may be missing in a task's simulation."""

import numpy as np
from hydra.utils import instantiate

from mpc_sgft.command.compose import compose
from mpc_sgft.diagnose.candidates.suspects import suspects


def test_fits_of_a_drift_start_with_every_sign() -> None:
    task = instantiate(compose("deploy", ["task=insert"], []).task.env, _convert_="all")
    (drift,) = suspects(task, ["actuator_offset"])
    assert len(drift.starts) == len({tuple(np.sign(s)) for s in drift.starts}) == 8
