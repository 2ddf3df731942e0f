"""What a rollout tells of the draws, and rollouts that tell more."""

import numpy as np
import pytest
import torch

from mpc_sgft.command.compose import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build
from mpc_sgft.runs.exploration import STEP, explore, information
from mpc_sgft.storage import checkpoint
from planners.exploring import ExploringPlanner, offset_at
from planners.policy import PolicyPlanner
from tools import asid


def pretraining(*words: str):
    return compose("pretrain", ["+experiment=debug", *words], [])


def test_it_is_what_differences_of_simulations_one_by_one_give() -> None:
    cfg, offsets = pretraining("task=pendulum"), torch.tensor([[[1.0], [-1.0]], [[0.2], [0.2]]])
    weight = torch.tensor([0.7, 0.0])
    env = build.make_env(cfg, 2 * 2 * 5, randomised=True)
    model = build.make_agent(cfg, env).model.eval()
    found = information(env, model, weight, offsets, 2, seed=3, noise=0.01)
    again = information(env, model, weight, offsets, 2, seed=3, noise=0.02)
    torch.testing.assert_close(found, 4 * again)
    centre, wanted = env.backend.randomizer.given.reshape(2, 2, 5, 2)[0, :, 0], torch.zeros(2, 2, 2)
    for m in range(2):
        for s in range(2):
            actions, seen = [], []
            for aside in ([0, 0], [STEP, 0], [0, STEP], [-STEP, 0], [0, -STEP]):
                one = build.make_env(cfg, 1, randomised=True)
                one.backend.randomizer.given = centre[s : s + 1] + np.array([aside])
                one.set_seed(3)
                one.backend.rngs = [np.random.default_rng((3, s))]
                state, path = one.reset(), []
                for t in range(40):
                    if len(seen) == 0:
                        with torch.no_grad():
                            prior = model.policy_prior(model.encode(state["observation"]), None)
                        push = offset_at(offsets[m], torch.tensor([t / 39]))
                        actions.append((weight[m] * prior + push).clamp(-1, 1))
                    state["action"] = actions[t]
                    state = one.step(state)["next"]
                    path.append(state["observation"][0])
                seen.append(torch.stack(path).double())
            slope = torch.stack([seen[1] - seen[3], seen[2] - seen[4]], -1) / (2 * STEP * 0.01)
            wanted[m] += torch.einsum("tod,toe->de", slope, slope).float() / 2
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3 * float(wanted.max()))


def test_who_never_touches_the_puck_learns_nothing_of_it() -> None:
    cfg = pretraining("task=push")
    env = build.make_env(cfg, 2 * 9, randomised=True)
    model = build.load_agent(cfg)[0].model.eval()
    aside = torch.tensor([[[-1.0, 0.0]], [[0.0, 0.0]]])
    env.backend.noise_sd = 0.0
    back, policy = information(env, model, torch.tensor([0.0, 1.0]), aside, 4, seed=1, noise=0.004)
    puck, servos = back.diagonal()[:2], back.diagonal()[2:]
    assert (puck == 0).all() and servos.min() > 0.5
    assert policy.diagonal()[:2].min() > 10, "the policy pushes it"


def test_what_is_found_tells_more_than_the_policy_alone() -> None:
    cfg = pretraining("task=pendulum")
    model = build.make_agent(cfg, build.make_env(cfg, 1)).model.eval()  # knows nothing, and hardly moves
    found = explore(cfg, model, seed=0, knots=3, proposals=8, rounds=4)
    assert (found.left < found.plain).all() and found.left.sum() < 0.5 * found.plain.sum()
    assert found.left.max() < 12**-0.5
    words = asid.overrides(found, 2)
    made = compose("deploy", ["task=pendulum", *words], [])
    driver = build.make_warm_up(made, build.make_env(made, 1))
    assert isinstance(driver, ExploringPlanner) and made.warmup == 2
    torch.testing.assert_close(torch.tensor(driver.offsets), found.offsets, atol=0.006, rtol=0)
    plain = compose("deploy", ["task=pendulum"], [])
    assert isinstance(build.make_warm_up(plain, build.make_env(plain, 1)), PolicyPlanner)
    wrong = compose("deploy", ["task=pendulum", "exploration.offsets=[[0.1,0.2]]"], [])
    with pytest.raises(UserError, match="warmup=0"):
        build.make_warm_up(wrong, build.make_env(wrong, 1))
    wrong.warmup = 1
    with pytest.raises(UserError, match="1 numbers each"):
        build.make_warm_up(wrong, build.make_env(wrong, 1))
    wrong.exploration = {"weight": 0.5, "offsets": []}
    with pytest.raises(UserError, match="goes with exploration.offsets"):
        build.make_warm_up(wrong, build.make_env(wrong, 1))


def test_the_command_prints_words_for_deploy(capsys, tmp_path) -> None:
    cfg = compose("pretrain", ["task=pendulum"], [])
    model = build.make_agent(cfg, build.make_env(cfg, 1)).model
    checkpoint.save(tmp_path / "a.safetensors", model, checkpoint.describe(cfg, model))
    words = ["--task", "pendulum", "--checkpoint", str(tmp_path / "a.safetensors"), "--rounds", "1", "--quiet"]
    assert asid.main([*words, "--rollouts", "3"]) == 0
    *told, line = capsys.readouterr().out.splitlines()
    assert [text.split(":")[0] for text in told] == ["# mass", "# damping"]
    made = compose("deploy", ["task=pendulum", *line.split()], [])
    assert made.warmup == 3 and len(made.exploration.offsets) == 8
    assert asid.main([*words, "--randomize", "none"]) == 2
    assert "draws nothing" in capsys.readouterr().err
    assert asid.main(["--task", "pendulum", "--checkpoint", "nowhere", "--quiet"]) == 2
    assert "nowhere" in capsys.readouterr().err
