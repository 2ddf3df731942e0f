"""The gate between what trains and what acts, and the command map that a few rollouts can teach."""

import copy
import math
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.choice import Choice, Verdict, begins
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.transfer import Transfer, mean_error, open_loop_error
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.methods.sgft import SGFT
from tests.mpc_sgft.learning.agents import SENSED

SIZES = {"obs_dim": 6, "action_dim": 2, "decode_dim": 3, "latent_dim": 16, "mlp_dim": 32, "enc_dim": 32, "num_q": 2}
CONFIGS = Path(__file__).resolve().parents[3] / "configs"
MEMORY = {"memory_dim": 2, "action_dim": 1, "obs_dim": 6, "decode_dim": 2}
TIP = Sensed(SENSED.names[:2], SENSED.starts[:, :2])  # what is observed then


def make_agent(sizes: dict | None = None, **changes) -> Agent:
    torch.manual_seed(0)
    numbers = {k: v for k, v in OmegaConf.load(CONFIGS / "train/default.yaml").agent.items() if k != "_target_"}
    return Agent(WorldModel(**(SIZES | (sizes or {}))), **(numbers | {"discount": 0.9} | changes))


def make_sgft(**changes) -> SGFT:
    plain = {
        "horizon": 2,
        "gate_excess": 0.0,
        "anchor": 0.0,
        "command_map": False,
        "command_band": False,
        "observation_map": False,
        "suspicion_margin": 0.0,
        "lr_decay": 0.0,
        "average_decay": 0.0,
        "policy_share": 1.0,
        "win_stay": 0,
        "slice_len": 2,
    }
    numbers = OmegaConf.load(CONFIGS / "method/sgft.yaml")
    return SGFT(**{k: (plain | changes).get(k, numbers._get_node(k)._value()) for k in numbers if k != "_target_"})


def rollout(model: WorldModel, steps: int = 12, seed: int = 0) -> TensorDict:
    """An episode [T] of random observations."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(steps + 1, model.obs_dim, generator=generator)
    action = 2 * torch.rand(steps, model.action_dim, generator=generator) - 1
    flags = {k: torch.zeros(steps, 1, dtype=torch.bool) for k in ("terminated", "truncated", "done", "invalid")}
    following = {"observation": observation[1:], "reward": torch.zeros(steps, 1), **flags}
    return TensorDict(
        {
            "observation": observation[:-1],
            "action": action,
            "episode": torch.full((steps,), seed),
            "step": torch.arange(steps),
            "next": TensorDict(following, [steps]),
        },
        [steps],
    )


def transfer(
    gate: bool = True, updates: int = 5, margin: float = 0.9, of_method: dict | None = None, **changes
) -> Transfer:
    method = make_sgft(lr=1e-2, gate=gate, updates=updates, gate_margin=margin, **(of_method or {}))
    sensed = TIP if changes.get("sizes") == MEMORY else SENSED
    return Transfer(make_agent(**changes), method, sensed, capacity=200, batch_size=16, seed=0)


def same(a: WorldModel, b: WorldModel) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))


def test_nothing_acts_before_it_predicted_an_unseen_rollout_better():
    t = transfer(updates=60)
    data = rollout(t.pretrained)
    t.learn(data)
    assert same(t.acting, t.pretrained) and not same(t.agent.model, t.pretrained)
    t.learn(data)  # the same world again: what was learned predicts it better
    assert t.verdicts[-1].fine_tuned < 0.9 * t.verdicts[-1].pretrained
    assert t.verdicts[-1].accepted and same(t.acting, t.agent.model)


@pytest.mark.parametrize(("share", "acts", "goes_on"), [(0.85, False, True), (0.75, True, True), (1.1, False, False)])
def test_who_acts_goes_on_while_it_is_better_at_all(share: float, acts: bool, goes_on: bool, monkeypatch):
    """The margin of 0.8 is for who does not act yet; errors of later rollouts are set here."""
    for before, wanted in ((False, acts), (True, goes_on)):
        t = transfer(updates=1, margin=0.8)
        t.verdicts = [Verdict(1.0, 1.0, False), Verdict(1.0, share, before)]
        monkeypatch.setattr(
            "mpc_sgft.learning.transfer.open_loop_error",
            lambda model, *_, t=t: torch.full((2, 2), 1.0 if model is t.pretrained else share),
        )
        t.learn(rollout(t.pretrained))
        assert t.verdicts[-1].accepted is wanted
        assert same(t.acting, t.averaged.model if wanted else t.pretrained)


@pytest.mark.parametrize(("odd", "accepted"), [(3.0, True), (10.0, False)])
def test_one_odd_rollout_does_not_shut_the_gate(odd, accepted):
    """0.5^4 * 3 = 0.19 < 0.9^5 = 0.59 < 0.5^4 * 10, although the sums would say 5 > 0.9 * 5."""
    errors = [(error, 1.0) for error in (0.5, 0.5, 0.5, 0.5, odd)]
    assert begins(errors, acts=False, margin=0.9) is accepted


def test_without_the_gate_what_trains_acts_at_once():
    t = transfer(gate=False)
    t.learn(rollout(t.pretrained))
    assert same(t.acting, t.agent.model) and not same(t.acting, t.pretrained)


@pytest.mark.parametrize(("excess", "beneath"), [(0.5, True), (2.0, False)])
def test_the_dynamics_beneath_the_maps_stay_where_simulation_is_predicted_as_badly(excess: float, beneath: bool):
    """Real and simulated steps are alike here, so their errors are."""
    numbers = {"gate_excess": excess, "command_map": True, "updates": 60, "lr": 1e-2, "gate_margin": 0.98}
    agent = make_agent(MEMORY)
    simulated = torch.stack([rollout(agent.model, seed=seed) for seed in range(32)])
    asked = []

    def simulate(episodes: int) -> TensorDict:
        asked.append(episodes)
        return simulated

    sizes = {"capacity": 200, "batch_size": 16, "seed": 0, "simulated": simulate}
    t = Transfer(agent, make_sgft(**numbers), SENSED, **sizes)
    assert not asked  # the first rollout need not wait for it
    for _ in range(2):
        t.learn(simulated[0])
    verdict, acting, learned = t.verdicts[-1], t.acting.dynamics, t.averaged.model.dynamics
    assert asked == [32] and verdict.accepted and verdict.beneath is beneath
    errors = torch.stack([open_loop_error(t.pretrained, steps, 2).nanmean() for steps in simulated])
    assert t.simulated_error == pytest.approx(float(errors.log().mean().exp()), rel=1e-5)
    assert torch.equal(acting.command.weight, learned.command.weight)
    wanted = learned.base if beneath else t.pretrained.dynamics.base
    assert not torch.equal(learned.base[0].linear.weight, t.pretrained.dynamics.base[0].linear.weight)
    assert torch.equal(acting.base[0].linear.weight, wanted[0].linear.weight)
    again = Transfer(make_agent(MEMORY), make_sgft(**numbers), SENSED, **sizes)
    again.load_state_dict(t.state_dict())
    again.learn(simulated[1])
    assert asked == [32] and again.simulated_error == t.simulated_error


@pytest.mark.parametrize("gate", [True, False])
@pytest.mark.parametrize("acts", [True, False])
@pytest.mark.parametrize("share", [0.75, 0.85, 1.1])
def test_a_dead_band_acts_once_it_tells_unseen_rollouts_better(gate: bool, acts: bool, share: float, monkeypatch):
    """By the gate's margin of 0.8, or at all where it acts already; without a gate, at all."""
    t = transfer(gate=gate, updates=1, margin=0.8, sizes=MEMORY, of_method={"command_map": True, "command_band": True})

    def error(model: WorldModel, *_) -> torch.Tensor:
        return torch.full((2, 2), share if model.dynamics.band_acts else 1.0)

    monkeypatch.setattr("mpc_sgft.learning.transfer.open_loop_error", error)
    steps = rollout(t.pretrained)
    t.verdicts = [Verdict(1.0, 1.0, False), Verdict(1.0, 1.0, True, mapped=1.0, band=Choice(1.0, share, acts))]
    for model in (t.agent.model, t.averaged.model):
        model.use_band(acts)
    metrics = t.learn(steps)
    wanted = share < (0.8 if gate and not acts else 1.0)
    assert t.verdicts[-1].band.rival_acts is wanted and metrics["band_acts"] == wanted
    assert (metrics["error_mapped"], metrics["error_banded"]) == pytest.approx((1.0, share))
    assert all(bool(m.dynamics.band_acts) == wanted for m in (t.agent.model, t.averaged.model))
    accepted = wanted if gate else True
    assert bool(t.acting.dynamics.band_acts) == (wanted and accepted)
    assert not t.pretrained.dynamics.band_acts


@pytest.mark.parametrize("acts", [True, False])
@pytest.mark.parametrize("share", [0.45, 0.55, 1.1])
def test_a_suspicion_acts_once_it_tells_unseen_rollouts_much_better(acts: bool, share: float, monkeypatch):
    """By a margin of its own, or at all where it acts already."""
    numbers = {"command_map": True, "observation_map": True, "suspicion_margin": 0.5}
    t = transfer(updates=1, margin=0.8, sizes=MEMORY, of_method=numbers)

    def error(model: WorldModel, *_) -> torch.Tensor:
        return torch.full((2, 2), share if model.observation_map.suspects else 1.0)

    monkeypatch.setattr("mpc_sgft.learning.transfer.open_loop_error", error)
    t.verdicts = [Verdict(1.0, 1.0, False), Verdict(1.0, 1.0, True, suspicion=Choice(1.0, share, acts))]
    metrics = t.learn(rollout(t.pretrained))
    wanted = share < (1.0 if acts else 0.5)
    assert t.verdicts[-1].suspicion == Choice(1.0, pytest.approx(share), wanted) and metrics["suspicion_acts"] == wanted
    assert (metrics["error_mapped"], metrics["error_suspected"]) == pytest.approx((1.0, share))
    for model in (t.agent.model, t.averaged.model, t.acting):
        assert bool(model.observation_map.suspects) == bool(model.dynamics.joint_acts) == wanted
    assert not t.pretrained.observation_map.suspects


def test_what_succeeds_tells_nothing_of_a_suspicion(monkeypatch):
    """It neither begins nor ends one, and does not count for a later rollout that fails."""
    t = transfer(updates=1, of_method={"observation_map": True, "suspicion_margin": 0.5, "gate_memory": 2})
    share = 0.1
    monkeypatch.setattr(
        "mpc_sgft.learning.transfer.open_loop_error",
        lambda model, *_: torch.full((2, 2), share if model.observation_map.suspects else 1.0),
    )

    def acts(of: float, success: bool) -> bool:
        nonlocal share
        share = of
        return bool(t.learn(rollout(t.pretrained, seed=len(t.verdicts)), success=success)["suspicion_acts"])

    assert not acts(0.1, False)  # the first one
    assert not acts(0.1, True) and not acts(0.1, True)
    assert not acts(0.6, False)
    assert not acts(0.1, True)
    assert acts(0.3, False), "with the 0.6 before"
    assert acts(9.0, True) and acts(9.0, True)
    assert acts(1.1, False), "with the 0.3 before"
    t.correct(t.verdicts[-1].episode, True)
    assert acts(3.0, False), "with the 0.3 before: what was marked does not count"
    assert not acts(1.1, False)


def test_the_first_rollout_tells_nothing_of_a_suspicion(monkeypatch):
    """Then nothing has been learned, and both are the same but for rounding."""
    t = transfer(updates=1, of_method={"observation_map": True, "suspicion_margin": 0.5})
    monkeypatch.setattr(
        "mpc_sgft.learning.transfer.open_loop_error",
        lambda model, *_: torch.full((2, 2), 0.1 if model.observation_map.suspects else 1.0),
    )
    t.learn(rollout(t.pretrained))
    assert t.verdicts[-1].suspicion == Choice(1.0, pytest.approx(0.1), False)
    t.learn(rollout(t.pretrained))
    assert t.verdicts[-1].suspicion.rival_acts


def test_a_rollout_is_looked_at_with_the_maps_that_act_now():
    band, suspicion = Choice(2.0, 3.0, False), Choice(4.0, 5.0, False)
    verdict = Verdict(1.0, 1.0, True, mapped=2.0, band=band, suspicion=suspicion)
    assert verdict.with_maps_of(verdict) == 2.0
    assert verdict.with_maps_of(verdict._replace(band=Choice(0.0, 0.0, True))) == 3.0
    assert verdict.with_maps_of(verdict._replace(suspicion=Choice(0.0, 0.0, True))) == 5.0


def test_which_maps_act_is_kept():
    numbers = {"command_map": True, "command_band": True, "observation_map": True, "suspicion_margin": 0.5}
    t = transfer(sizes=MEMORY, of_method=numbers)
    t.learn(rollout(t.pretrained))
    for model in (t.agent.model, t.acting):
        model.use_band(True)
        model.suspect(True)
    again = transfer(sizes=MEMORY, of_method=numbers)
    again.load_state_dict(t.state_dict())
    for model in (again.agent.model, again.acting):
        assert model.dynamics.band_acts and model.observation_map.suspects and model.dynamics.joint_acts
    assert again.verdicts == t.verdicts and isinstance(again.verdicts[0].suspicion, Choice)


@pytest.mark.parametrize("margin", [-0.1, 1.0])
def test_a_suspicion_must_lower_the_error(margin: float):
    with pytest.raises(ValueError, match=rf"suspicion_margin={margin} must lie in \[0, 1\)"):
        make_sgft(suspicion_margin=margin)
    assert make_sgft(suspicion_margin=0.5, observation_map=False).suspicion_margin == 0


def test_a_negative_excess_is_refused_and_without_a_gate_there_is_none():
    with pytest.raises(ValueError, match="gate_excess=-1.0 must be 0 or more"):
        make_sgft(gate_excess=-1.0)
    assert make_sgft(gate_excess=2.0, gate=False).gate is None


def test_a_comparison_with_simulation_needs_simulated_episodes():
    with pytest.raises(ValueError, match="SGFT needs simulated episodes here"):
        transfer(of_method={"gate_excess": 2.0})


def test_what_acts_is_the_average_of_the_last_updates_with_a_share_of_the_policy_s_change():
    decay, share, updates = 0.5, 0.25, 3
    t = transfer(gate=False, updates=updates, of_method={"average_decay": decay, "policy_share": share})
    seen, follow = [], t.averaged.follow

    def note(model: WorldModel) -> None:
        seen.append([p.detach().clone() for p in model.parameters()])
        follow(model)

    t.averaged.follow = note
    t.learn(rollout(t.pretrained))
    assert len(seen) == updates
    for k, (name, acts) in enumerate(t.acting.named_parameters()):
        average = 0.25 * seen[0][k] + 0.25 * seen[1][k] + 0.5 * seen[2][k]
        before = t.pretrained.get_parameter(name)
        wanted = before + share * (average - before) if name.startswith("policy_head.") else average
        assert torch.allclose(acts, wanted, atol=1e-6), name
    assert not same(t.acting, t.averaged.model)


def test_who_wins_stays_until_a_rollout_fails():
    t = transfer(gate=False, of_method={"win_stay": 2})
    for success, learns in ((True, True), (False, True), (True, True), (True, False), (True, False), (False, True)):
        acting, trained = copy.deepcopy(t.acting), copy.deepcopy(t.agent.model)
        metrics = t.learn(rollout(t.pretrained, seed=len(t.verdicts)), success=success)
        assert (not same(t.acting, acting), not same(t.agent.model, trained)) == (learns, learns), len(t.verdicts)
        assert ("grad_norm" in metrics) is learns and "error_fine_tuned" in metrics and t.stays is not learns
    assert len(t.buffer) == 6 * 12 and len(t.starts) == len(t.verdicts) == 6  # what was not learned from is kept
    t.correct(episode=4, success=False)  # a person says so later
    assert not t.stays


def test_only_what_acts_wins_and_a_broken_streak_begins_anew():
    t = transfer(gate=False, of_method={"win_stay": 2})

    def stays(**how: bool) -> bool:
        t.learn(rollout(t.pretrained, seed=len(t.verdicts)), success=True, **how)
        return t.stays

    assert [stays(warm_up=True) for _ in range(3)] == [False] * 3  # the simulation policy drove
    assert [stays(), stays()] == [False, True]
    t.interrupt()  # a person took over
    again = transfer(gate=False, of_method={"win_stay": 2})
    again.load_state_dict(t.state_dict())
    assert not again.stays and [stays(), stays()] == [False, True]


def test_nothing_is_decided_while_what_wins_stays(monkeypatch):
    """Errors are set here: what was learned predicts better until it wins, and worse then."""
    t, share = transfer(updates=1, margin=0.8, of_method={"win_stay": 2, "gate_memory": 2}), 0.5
    monkeypatch.setattr(
        "mpc_sgft.learning.transfer.open_loop_error",
        lambda model, *_: torch.full((2, 2), 1.0 if model is t.pretrained else share),
    )
    for success in (False, False, True):
        t.learn(rollout(t.pretrained), success=success)
    share = 3.0
    for _ in range(3):
        t.learn(rollout(t.pretrained), success=True)
        assert t.stays and t.verdicts[-1].accepted and same(t.acting, t.averaged.model)
    share = 0.3
    t.learn(rollout(t.pretrained), success=False)
    assert t.verdicts[-1].accepted and same(t.acting, t.averaged.model), "0.9 of the error in two rollouts"


def test_a_saved_transfer_goes_on_with_the_same_numbers():
    once, twice = (transfer(of_method={"average_decay": 0.9, "policy_share": 0.5}) for _ in range(2))
    for t in (once, twice):
        t.learn(rollout(t.pretrained, seed=1))
    again = transfer(of_method={"average_decay": 0.9, "policy_share": 0.5})
    again.load_state_dict(twice.state_dict())
    once.learn(rollout(once.pretrained, seed=2))
    again.learn(rollout(again.pretrained, seed=2))
    assert same(once.agent.model, again.agent.model) and once.verdicts == again.verdicts
    assert same(once.averaged.model, again.averaged.model) and same(once.acting, again.acting)


def test_an_episode_that_ended_early_is_not_imagined_beyond():
    model = make_agent().model
    parts = [rollout(model, 6, seed=1), rollout(model, 4, seed=2), rollout(model, 1, seed=3)]
    parts[1]["next", "invalid"][-1] = True
    alone = [open_loop_error(model, steps, 2).nanmean().item() for steps in (parts[0], parts[1][:-1])]
    row = torch.cat(parts).unsqueeze(0)
    assert mean_error(model, row, 2) == pytest.approx(math.sqrt(math.prod(alone)))


def test_which_maps_act_is_nothing_that_was_frozen():
    """With a residual as well, where the rest of the dynamics is."""
    numbers = {"residual": True, "command_map": True, "command_band": True, "observation_map": True}
    t = transfer(updates=1, sizes=MEMORY, of_method=numbers | {"suspicion_margin": 0.5})
    frozen = t.agent.frozen_hash()
    t.agent.model.use_band(True)
    t.agent.model.suspect(True)
    assert t.agent.frozen_hash() == frozen
    with torch.no_grad():
        t.agent.model.dynamics.base[0].linear.bias += 1.0
    assert t.agent.frozen_hash() != frozen


def test_open_loop_error_by_hand():
    t = transfer()
    data, model = rollout(t.pretrained, steps=4), t.pretrained
    error = open_loop_error(model, data, 3)
    z = model.encode(data["observation"][1:2])
    for k in (1, 2):
        z = model.next(z, data["action"][k : k + 1])
    expected = (z - model.encode(data["next", "observation"][2:3])).square().mean()
    assert torch.isclose(error[1, 1], expected)
    assert error[3, 1:].isnan().all() and not error[:2].isnan().any()


def test_the_latent_carries_past_commands_exactly():
    model = WorldModel(**(SIZES | MEMORY))
    observation = torch.randn(5, 6)
    z = model.encode(observation)
    assert torch.equal(z[:, -2:], observation[:, -2:])
    action = torch.rand(5, 1)
    assert torch.equal(model.next(z, action)[:, -2:], torch.cat([action, observation[:, -2:-1]], 1))


def test_a_command_map_starts_as_the_identity_and_recovers_gain_and_delay():
    torch.manual_seed(0)
    model = WorldModel(**(SIZES | MEMORY))
    truth = WorldModel(**(SIZES | MEMORY))
    truth.load_state_dict(model.state_dict())
    z, action = model.encode(torch.randn(256, 6)), 2 * torch.rand(256, 1) - 1
    before = model.next(z, action)
    model.add_command_map()
    truth.add_command_map()
    assert torch.equal(model.next(z, action), before)
    with torch.no_grad():  # 0.3 of this command, 0.5 of the one before, and a drift
        truth.dynamics.command.weight.copy_(torch.tensor([[0.3, 0.5, 0.0]]))
        truth.dynamics.command.bias.fill_(0.1)
        target = truth.next(z, action)
    optimizer = torch.optim.Adam(model.dynamics.command.parameters(), lr=2e-2)
    for _ in range(400):
        loss = (model.next(z.detach(), action) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert torch.allclose(model.dynamics.command.weight, torch.tensor([[0.3, 0.5, 0.0]]), atol=0.02)
    assert model.dynamics.command.bias.item() == pytest.approx(0.1, abs=0.02)


def test_with_a_command_map_everything_else_stays_frozen():
    agent = make_agent(sizes=MEMORY)
    method = make_sgft(command_map=True, anchor=0.1)
    method.take_over(agent, SENSED)
    before, frozen = agent.model.dynamics.command.weight.clone(), agent.frozen_hash()
    method.update(agent, rollout(agent.model, 6)[:4].unflatten(0, (2, 2)), starts=torch.zeros(1, agent.model.obs_dim))
    assert agent.frozen_hash() == frozen
    assert not torch.equal(before, agent.model.dynamics.command.weight)
