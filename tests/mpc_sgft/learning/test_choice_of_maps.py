"""Which maps act, and whether the dynamics beneath them do, by how they foretell unseen rollouts."""

import pytest
import torch
from tensordict import TensorDict

from mpc_sgft.learning.choice import Choice, Verdict
from mpc_sgft.learning.transfer import Transfer, open_loop_error
from mpc_sgft.learning.world_model import WorldModel
from tests.mpc_sgft.learning.agents import SENSED
from tests.mpc_sgft.learning.transfers import MEMORY, make_agent, make_sgft, rollout, transfer


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
    for wrong in ({"gate_memory": 0}, {"gate_margin": 0.0}, {"average_decay": 1.0}, {"policy_share": 2.0}):
        with pytest.raises(ValueError, match="{}={} must".format(*next(iter(wrong.items())))):
            make_sgft(**wrong)
    assert make_sgft(gate_excess=2.0, gate=False).gate is None


def test_a_comparison_with_simulation_needs_simulated_episodes():
    with pytest.raises(ValueError, match="SGFT needs simulated episodes here"):
        transfer(of_method={"gate_excess": 2.0})


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
