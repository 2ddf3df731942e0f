"""The timing tool counts arithmetic right and writes what it measured."""

import csv
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch.utils.flop_counter import FlopCounterMode

from mpc_sgft.learning.world_model import WorldModel
from planners.mppi import MPPI
from tools.benchmarks import time_planner
from tools.benchmarks.time_planner import ROOT, main, mlp_flop, plan_flop, random_batch, update_flop

SIZES = {"obs_dim": 5, "action_dim": 2, "decode_dim": 5, "latent_dim": 16, "mlp_dim": 64, "enc_dim": 20}


def test_a_perceptron_by_hand() -> None:
    assert mlp_flop(3, 4, 2) == 2 * (3 * 4 + 4 * 2)


@pytest.mark.parametrize(("num_q", "decay"), [(2, 1.0), (5, 1.5)])
def test_the_formulas_are_what_torch_counts(num_q: int, decay: float) -> None:
    model = WorldModel(**SIZES, num_q=num_q)
    search = {"num_candidates": 64, "num_prior": 8, "num_elites": 8, "iterations": 2, "candidate_decay": decay}
    planner = MPPI(action_dim=2, horizon=3, **search)
    with FlopCounterMode(display=False) as plan:
        planner.plan(model, torch.rand(1, 16), None, None, torch.Generator())
    assert plan_flop(model, planner) == pytest.approx(plan.get_total_flops(), rel=0.03)
    agent = instantiate(OmegaConf.load(ROOT / "configs/train/default.yaml").agent, model=model, discount=0.99)
    with FlopCounterMode(display=False) as update:
        agent.update(random_batch(5, 2, 3))
    assert update_flop(model, 3) == pytest.approx(update.get_total_flops(), rel=0.05)


def test_measures_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_planner, "keep_freed_memory", lambda: False)  # this process is not ours to change
    out = tmp_path / "deeper" / "t.csv"
    assert main(["--quick", "--sizes", "small", "--threads", "1", "--precisions", "float32", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [(row["what"], row["horizon"], row["decay"], row["rows"]) for row in rows] == [
        ("plan", "3", "1.0", "1"), ("update", "3", "", "256"),
        ("plan", "4", "1.0", "1"), ("plan", "4", "1.25", "1"), ("update", "4", "", "256"),
    ]  # fmt: skip
    assert float(rows[3]["gflop"]) < 0.75 * float(rows[2]["gflop"])
    for row in rows:
        assert 0 < float(row["share_of_peak"]) < 1.5 and float(row["median_ms"]) > 0
        assert row["cpu"] and row["cores"] and row["torch"] == torch.__version__ and row["malloc"] == "default"
    assert "upstream" in capsys.readouterr().out
