"""Regret is measured against the same search, ten times as wide."""

from __future__ import annotations

from mpc_sgft.api import load_agent
from tools.studies.plan_quality import config, latents, regret


def test_the_wide_search_regrets_nothing_and_a_single_try_much() -> None:
    plain = config("none", "SHIPPED", "planner.num_candidates=16 planner.num_prior=2 planner.num_elites=8")
    model = load_agent(plain).model
    z = latents(plain, model, 20)
    wide = config("none", "SHIPPED", "planner.num_candidates=160 planner.num_prior=20 planner.num_elites=80")
    assert regret(wide, plain, model, z)[0] == 0.0
    blind = config("none", "SHIPPED", "planner.num_candidates=2 planner.num_prior=0 planner.num_elites=1")
    behind, spread = regret(blind, plain, model, z)
    assert behind > 0.1 and spread > 0
