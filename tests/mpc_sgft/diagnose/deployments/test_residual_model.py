"""A law that no name holds is found in a deployment, and none is where nothing is left."""

from __future__ import annotations

import numpy as np

from mpc_sgft.diagnose.deployed import diagnose_run
from mpc_sgft.diagnose.deployments.motion_link import JOINT_SAMPLES
from mpc_sgft.diagnose.deployments.residual_model import _between, _ridge

FITTED, BLOCKS = np.arange(24), np.arange(24) // 3


def test_what_no_name_explains_is_unknown_if_it_follows_a_law(deployed) -> None:
    run = deployed({"actuator_gain": {"gain": 0.7}}, episodes=8)
    report = diagnose_run(run, effects=["contact_friction"], max_effects=1).as_dict()
    assert report["verdict"] == "unknown" and "a flexible residual model explains" in report["reason"]
    base = next(c["held_out_error"] for c in report["candidates"] if not c["effects"])
    assert report["residual_model_error"] < base - 0.3 and report["repaired_model"] is None
    named = diagnose_run(run, effects=["actuator_gain"], max_effects=1).as_dict()
    assert named["verdict"] == "effect" and named["residual_model_error"] is None


def test_a_law_is_learned_from_other_blocks_and_noise_is_none() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(30, 6, 8))
    law = a @ rng.normal(size=8)
    told = _ridge(a, 5 * law + rng.normal(size=law.shape), FITTED, BLOCKS)
    assert np.abs(told - 5 * law).std() < 0.6, "windows that are held out too"
    noise = rng.normal(size=law.shape)
    left = np.square(noise - _ridge(a, noise, FITTED, BLOCKS))[FITTED].mean() / np.square(noise[FITTED]).mean()
    assert 0.99 < left < 1.05, "a window that is foretold was not learned from"


def test_within_a_step_changes_grow_evenly() -> None:
    ends = np.array([1.0, 3.0])[None, :, None]
    between = _between(ends)[0, :, 0]
    np.testing.assert_allclose(between[:JOINT_SAMPLES], np.arange(1, 6) / 5)
    np.testing.assert_allclose(between[JOINT_SAMPLES:], 1 + 2 * np.arange(1, 6) / 5)
