"""The gaps that are kept aside can be closed: who knows them nearly always succeeds, and who does not less often."""

import numpy as np
import pytest
import yaml

from tests.envs.conftest import CONFIGS, first_and_last, told

SHORT = {"push": 0.01, "push_ball": 0.03}  # [m] before the line, where what is pushed is let go
EPISODES = {"push": 32, "hammer": 32, "insert": 32, "push_towel": 12, "push_ball": 12}


@pytest.mark.parametrize("name", list(EPISODES))
def test_who_knows_the_gap_closes_it(make_backend, name: str) -> None:
    gap = yaml.safe_load((CONFIGS / f"gap/{name}_once.yaml").read_text())["effects"]
    rates = []
    for known in (gap, {}):
        backend = make_backend(name, EPISODES[name], effects_=gap)
        task, unseen = backend.task, np.zeros(len(backend.task.observation_names))
        if "sensor_offset" in gap:
            unseen[[6, 7]] = gap["sensor_offset"]["offset"]  # the place of insert's hole

        def act(seen: np.ndarray, known: dict = known, task=task, unseen=unseen) -> np.ndarray:
            if known and name in SHORT:
                line, task.goal_x = task.goal_x, task.goal_x - SHORT[name]
                wanted = task.scripted(seen)
                task.goal_x = line
                return told(wanted, known)
            return told(task.scripted(seen - unseen if known else seen), known)

        _, seen = first_and_last(backend, act)
        rates.append(float(task.success(seen - unseen).mean()))
    assert rates[0] >= 0.9 and rates[1] <= rates[0] - 0.1, rates
