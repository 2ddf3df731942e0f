"""The audit of a rollout: Definition 1 where it makes sense."""

import csv

import pytest
import torch
from tensordict import TensorDict

from mpc_sgft.learning.audit import audit, write_audit
from mpc_sgft.learning.world_model import WorldModel

SIZES = dict(obs_dim=3, action_dim=2, decode_dim=3, latent_dim=16, mlp_dim=32, enc_dim=32, num_q=2)


def rollout(terminated: list[bool], invalid: list[bool]) -> TensorDict:
    count = len(terminated)
    observation = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    flags = {"terminated": torch.tensor(terminated)[:, None], "invalid": torch.tensor(invalid)[:, None]}
    return TensorDict({"next": TensorDict({"observation": observation, **flags}, [count])}, [count])


def test_states_without_a_value_or_a_reading_are_not_asked(tmp_path):
    torch.manual_seed(0)
    model, no = WorldModel(**SIZES).eval(), [False] * 4
    whole = audit(model, rollout(no, no)[:2], 0.95, seed=1)
    found = audit(model, rollout([False, False, False, True], [False, False, True, False]), 0.95, seed=1)
    torch.testing.assert_close(found.margin[:2], whole.margin)
    assert found.margin[2:].isnan().all() and found.action[2:].isnan().all() and found.share == whole.share
    write_audit(tmp_path / "audit.csv", 3, rollout(no, no), found.margin, ("x", "y", "z"))
    with (tmp_path / "audit.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["margin"] == "" for row in rows] == [False, False, True, True]
    assert float(rows[0]["margin"]) == pytest.approx(float(whole.margin[0]), abs=1e-4)


def test_a_table_that_a_full_disk_left_empty_begins_with_its_names(tmp_path):
    path, steps = tmp_path / "audit.csv", rollout([False], [False])
    path.touch()
    for number in (1, 2):
        write_audit(path, number, steps, torch.zeros(1), ("x", "y", "z"))
    lines = path.read_text().splitlines()
    assert lines[0] == "rollout,step,x,y,z,margin" and [line[0] for line in lines[1:]] == ["1", "2"]


def test_a_rollout_of_nothing_to_ask_has_no_share():
    found = audit(WorldModel(**SIZES).eval(), rollout([True], [False]), 0.95, seed=1)
    assert found.share != found.share and found.margin.isnan().all()
