"""The command map finds what the machine makes of commands, and leaves the dynamics what it cannot explain."""

import copy

import pytest
import torch
from tensordict import TensorDict

from mpc_sgft.learning.dynamics import CommandMap, Dynamics, side_by_side
from mpc_sgft.learning.fit import Maps, Penalty, fit_dynamics
from mpc_sgft.learning.slices import Slices, to_slices
from mpc_sgft.learning.world_model import WorldModel
from tests.mpc_sgft.learning.agents import hand_over, make_agent, make_batch

A, T, B = 2, 4, 64
TRUTH = torch.tensor([[0.5, -0.3], [0.3, 0.5]])  # half of the command, turned


def transitions(machine: Dynamics, generator: torch.Generator) -> TensorDict:
    """A batch [B, T] of what a machine does with random commands; latents stand for observations."""
    action = 2 * torch.rand(T, B, A, generator=generator) - 1
    z = [torch.cat([torch.rand(B, 16, generator=generator), 2 * torch.rand(B, 2 * A, generator=generator) - 1], 1)]
    for a in action:
        z.append(machine(z[-1], a))
    seen, nothing = torch.stack(z).transpose(0, 1), torch.zeros(B, T, 1)
    following = {"observation": seen[:, 1:], "reward": nothing, "terminated": nothing.bool()}
    batch = {"observation": seen[:, :-1], "action": action.transpose(0, 1), "next": TensorDict(following, [B, T])}
    return TensorDict(batch, [B, T])


def taught(agent, simulated: bool, updates: int = 300):
    """Dynamics and map after updates on a machine that is the simulator but for its commands."""
    dynamics = agent.model.dynamics
    agent.model.add_command_map()
    agent.train_only(("dynamics", "dynamics.command"), lr=3e-3, policy_lr=3e-3, command_lr=2e-2)
    machine = copy.deepcopy(dynamics).requires_grad_(False)
    machine.command.weight[:] = torch.cat([TRUTH, torch.zeros(A, 2 * A)], 1)
    own = copy.deepcopy(dynamics).requires_grad_(False)
    own.command = dynamics.command
    agent.model.encode_corrected = lambda z: z  # latents in place of observations
    generator = torch.Generator().manual_seed(0)
    for _ in range(updates):
        data = to_slices(transitions(machine, generator), agent.device)
        fit_dynamics(agent, data, rho=1.0, maps=Maps((own.command,), own) if simulated else None)
    return dynamics, own


@pytest.mark.parametrize("simulated", [True, False])
def test_a_turned_gain_is_found_and_the_dynamics_stay(simulated: bool) -> None:
    agent = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A})
    torch.nn.init.orthogonal_(agent.model.dynamics.base[-1].linear.weight)
    dynamics, own = taught(agent, simulated)
    off = (dynamics.command.weight[:, :A] - TRUTH).abs().max()
    pairs = zip(dynamics.base.parameters(), own.base.parameters(), strict=True)
    moved = sum(float((p.detach() - q).square().sum()) for p, q in pairs)
    if simulated:
        assert off < 0.03 and moved < 1.0
    else:
        assert off > 0.1, "both explain the data, and neither is the truth"


def test_a_value_is_taught_where_plans_read_it() -> None:
    """V of a state is that of what the simulator would have called its commands, in its loss as at a plan's end."""
    agent = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A})
    model = agent.model
    with torch.no_grad():
        model.add_command_map().weight[:, :A] = TRUTH
    agent.train_only(
        ("dynamics", "dynamics.command", "value_head", "q_ensemble", "policy_head"),
        lr=3e-3,
        policy_lr=3e-3,
        command_lr=0.0,
    )
    seen: list[torch.Tensor] = []
    model.value_head.register_forward_pre_hook(lambda _, x: seen.append(x[0].detach()))
    batch = make_batch()
    memory = torch.rand(*batch["observation"].shape[:2], 2 * A)
    for where in (batch, batch["next"]):
        where["observation"] = torch.cat([where["observation"], memory], -1)
    agent.update(batch)
    taught_on = next(x for x in seen if x.shape[:2] == (4, 32))  # [T + 1, B]: where the loss is
    raw = model.encode(batch["observation"][:, 0])[:, -2 * A :]
    torch.testing.assert_close(taught_on[0, :, -2 * A :], model.dynamics.realised(raw))
    assert not torch.allclose(taught_on[0, :, -2 * A :], raw)


def test_the_change_is_the_sum_of_absolute_differences() -> None:
    dynamics = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A}).model
    dynamics.add_command_map()
    assert dynamics.dynamics.command.change() == 0
    with torch.no_grad():
        dynamics.dynamics.command.weight[0, 0] = 0.5
        dynamics.dynamics.command.weight[1, 3] = -0.25
        dynamics.dynamics.command.bias[1] = 2.0
    assert dynamics.dynamics.command.change() == 2.75


def test_a_dead_band_brings_commands_nearer_to_zero() -> None:
    command = CommandMap(4, 2, band=True)
    assert command(torch.tensor([0.1, -0.7, 9.0, 9.0])).tolist() == pytest.approx([0.1, -0.7])
    with torch.no_grad():
        command.weight[0, 2] = 0.5
        command.band[:] = torch.tensor([0.4, 0.25])
    sent = torch.tensor([[0.3, -0.7, 0.0, 9.0], [-0.3, 0.2, 0.0, 9.0], [0.3, 0.25, 1.0, 9.0]])
    assert command(sent).flatten().tolist() == pytest.approx([0.0, -0.45, 0.0, 0.0, 0.4, 0.0])
    assert command.change().item() == pytest.approx(0.5 + 0.4 + 0.25)


def two_maps() -> WorldModel:
    """The first adds one to a command, the second takes a quarter off."""
    model = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A}).model
    first, second = model.add_command_map(), model.add_command_band()
    with torch.no_grad():
        first.bias.fill_(1.0)
        second.band.fill_(0.25)
    return model


def test_one_of_two_command_maps_acts() -> None:
    dynamics, sent = two_maps().dynamics, torch.ones(1, 3 * A)
    assert (dynamics.realised(sent) == 2.0).all()
    dynamics.band_acts.fill_(True)
    assert (dynamics.realised(sent) == 0.75).all()


def test_the_map_that_goes_with_a_suspicion_acts_before_both() -> None:
    model, sent = two_maps(), torch.ones(1, 3 * A)
    model.add_observation_map([])
    model.add_suspicion()
    with torch.no_grad():
        model.dynamics.joint.bias.fill_(2.0)
    for band, wanted in ((False, 2.0), (True, 0.75)):
        model.use_band(band)
        assert (model.dynamics.realised(sent) == wanted).all()
        model.suspect(True)
        assert model.observation_map.suspects and (model.dynamics.realised(sent) == 3.0).all()
        model.suspect(False)
        assert not model.observation_map.suspects
    with pytest.raises(ValueError, match="each once"):
        model.add_suspicion()


def test_side_by_side_each_has_its_own_share_of_the_batch() -> None:
    parts, generator = [two_maps().dynamics], torch.Generator().manual_seed(0)
    parts += [copy.deepcopy(parts[0]), copy.deepcopy(parts[0])]
    parts[1].band_acts.fill_(True)
    parts[2].command = None
    z = torch.rand(3, 4, 16 + 2 * A, generator=generator)
    action = torch.rand(3, 4, A, generator=generator)
    alone = torch.cat([dynamics(*share) for dynamics, *share in zip(parts, z, action, strict=True)])
    together = side_by_side(parts)(z.flatten(0, 1), action.flatten(0, 1))
    torch.testing.assert_close(together, alone)
    assert not torch.allclose(side_by_side(parts[::-1])(z.flatten(0, 1), action.flatten(0, 1)), alone)


def test_a_suspicion_needs_an_observation_map() -> None:
    model = two_maps()
    with pytest.raises(ValueError, match="add_observation_map"):
        model.add_suspicion()
    with pytest.raises(ValueError, match="add_observation_map"):
        model.suspect(True)


@pytest.mark.parametrize("suspects", [True, False])
def test_a_suspicion_learns_beside_the_maps_and_they_as_if_there_were_none(suspects: bool) -> None:
    """Slopes of the maps are the same whatever is suspected, and those of what is suspected whatever the maps are."""
    slopes = []
    for far in (0.0, 5.0):
        for shift in (0.0, 0.5):
            agent = make_agent(grad_clip=1e9)  # which all share
            numbers = {"command_map": True, "command_band": True, "observation_map": True, "suspicion_margin": 0.5}
            update = hand_over(agent, **numbers, slice_len=T)
            dynamics, sensors = agent.model.dynamics, agent.model.observation_map
            agent.model.suspect(suspects)
            dynamics.command.bias.data.fill_(far)
            sensors.shift.data.fill_(shift)
            sensors.doubt = lambda *_: None  # nothing is doubted
            update(make_batch(steps=T))
            state = agent.optimizers.model.state
            slopes.append([state[p]["exp_avg"].clone() for p in (dynamics.command.weight, dynamics.joint.weight)])
            slopes[-1].append(state[sensors.shift]["exp_avg"].clone())
    (plain, joint, shift), (same, _, _), (_, joint_far, shift_far), _ = slopes
    torch.testing.assert_close(plain, same)
    torch.testing.assert_close(joint, joint_far)
    torch.testing.assert_close(shift, shift_far)
    assert plain.abs().max() > 0 and joint.abs().max() > 0 and shift.abs().max() > 0


@pytest.mark.gpu
def test_what_was_recorded_follows_the_map_that_acts() -> None:
    dynamics, sent = two_maps().cuda().dynamics, torch.ones(1, 3 * A, device="cuda")
    graph = torch.cuda.CUDAGraph()
    with torch.no_grad():
        dynamics.realised(sent)
        with torch.cuda.graph(graph):
            made = dynamics.realised(sent)
    for acts, wanted in ((False, 2.0), (True, 0.75), (False, 2.0)):
        dynamics.band_acts.fill_(acts)
        graph.replay()
        assert (made == wanted).all()


def test_a_second_command_map_needs_a_first() -> None:
    model = make_agent().model
    with pytest.raises(ValueError, match="add_command_map, then add_command_band"):
        model.add_command_band()


def test_a_threshold_is_told_from_a_weak_arm() -> None:
    """A machine that gives 0.9 of a command and does nothing with a small one; a gain alone passes for weakness."""
    agent = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A})
    torch.nn.init.orthogonal_(agent.model.dynamics.base[-1].linear.weight)
    machine = copy.deepcopy(agent.model)
    machine.add_command_map()
    machine.add_command_band()
    machine.requires_grad_(False)
    machine.dynamics.band_acts.fill_(True)
    machine.dynamics.banded.weight.mul_(0.9)
    machine.dynamics.banded.band.fill_(0.35)
    update = hand_over(agent, command_map=True, command_band=True, slice_len=T, lr=1e-6)
    agent.model.encode_corrected = lambda z: z  # latents in place of observations
    generator = torch.Generator().manual_seed(0)
    for _ in range(400):
        update(transitions(machine.dynamics, generator))
    plain, banded = agent.model.dynamics.command, agent.model.dynamics.banded
    assert plain.band is None and plain.weight[:, :A].diagonal().max() < 0.75
    assert (banded.band - 0.35).abs().max() < 0.03
    assert (banded.weight[:, :A].diagonal() - 0.9).abs().max() < 0.05


@pytest.mark.parametrize("band_acts", [True, False])
def test_the_observation_map_learns_by_the_map_that_acts(band_acts: bool) -> None:
    """Its slope is that of the loss with this map alone: beside a rival that is far off it is the same."""
    shifts = []
    for far in (0.0, 5.0):
        agent = make_agent(grad_clip=1e9)  # which all share
        update = hand_over(agent, command_map=True, command_band=True, observation_map=True, slice_len=T)
        dynamics, sensors = agent.model.dynamics, agent.model.observation_map
        dynamics.band_acts.fill_(band_acts)
        (dynamics.command if band_acts else dynamics.banded).bias.data.fill_(far)
        sensors.doubted.fill_(1.0)
        sensors.doubt = lambda *_: None  # they stay doubted
        update(make_batch(steps=T))
        shifts.append(agent.optimizers.model.state[sensors.shift]["exp_avg"].clone())
    assert shifts[0].abs().max() > 0
    torch.testing.assert_close(*shifts)


def test_a_later_deployment_may_ask_for_a_band() -> None:
    agent = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A})
    hand_over(agent, command_map=True)
    assert agent.model.dynamics.banded is None
    hand_over(agent, command_map=True, command_band=True)
    trained = [id(p) for p in agent.optimizers.trained]
    assert id(agent.model.dynamics.banded.band) in trained and len(trained) == len(set(trained))


def test_without_a_command_map_there_is_no_band() -> None:
    agent = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A})
    hand_over(agent, command_map=False, command_band=True)
    assert agent.model.dynamics.command is None and agent.model.dynamics.banded is None


@pytest.mark.parametrize("weight", [0.0, 1e-4])
def test_few_causes_are_preferred_where_commands_look_alike(weight: float) -> None:
    """Commands that hardly change tell no lag from another; a weak arm is still found as a weak arm."""
    torch.manual_seed(0)
    agent = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A})
    dynamics = agent.model.dynamics
    torch.nn.init.orthogonal_(dynamics.base[-1].linear.weight)
    agent.model.add_command_map()
    agent.train_only(("dynamics", "dynamics.command"), lr=1e-4, policy_lr=1e-4, command_lr=2e-2)
    machine = copy.deepcopy(dynamics).requires_grad_(False)
    machine.command.weight[:] = torch.cat([0.7 * torch.eye(A), torch.zeros(A, 2 * A)], 1)
    own = copy.deepcopy(dynamics).requires_grad_(False)
    own.command = dynamics.command
    agent.model.encode_corrected = lambda z: z  # latents in place of observations
    action = (2 * torch.rand(1, B, A) - 1) + 0.02 * torch.randn(T, B, A)
    z = [torch.cat([torch.rand(B, 16), action[0].repeat(1, 2) + 0.02 * torch.randn(B, 2 * A)], 1)]
    for a in action:
        z.append(machine(z[-1], a))
    seen = torch.stack(z) + 0.05 * torch.cat([torch.randn(T + 1, B, 16), torch.zeros(T + 1, B, 2 * A)], -1)
    data = Slices(seen, action, torch.zeros(T, B), torch.zeros(T, B, dtype=torch.bool))
    sparse = (Penalty("command_change", weight, own.command.change),)
    for _ in range(500):
        fit_dynamics(agent, data, rho=1.0, maps=Maps((own.command,), own, sparse))
    off = (dynamics.command.weight - machine.command.weight).abs().max()
    assert off < 0.2 if weight else off > 0.35


@pytest.mark.parametrize("mapped", [True, False])
def test_tdmpc2_may_be_given_a_command_map(mapped: bool) -> None:
    """Its own loss finds a turned gain, where the dynamics may hardly move; without the map the error stays."""
    width = 16 + 2 * A
    agent = make_agent(sizes={"obs_dim": width, "memory_dim": 2 * A})
    torch.nn.init.orthogonal_(agent.model.dynamics.base[-1].linear.weight)
    machine = copy.deepcopy(agent.model)
    machine.add_command_map()
    machine.requires_grad_(False)
    machine.dynamics.command.weight[:] = torch.cat([TRUTH, torch.zeros(A, 2 * A)], 1)
    update = hand_over(agent, "tdmpc2", command_map=mapped, lr=1e-6)
    agent.model.encode_corrected = lambda z: z  # latents in place of observations
    generator, errors = torch.Generator().manual_seed(0), []
    for _ in range(300):
        errors.append(update(transitions(machine.dynamics, generator))["consistency_loss"])
    assert (errors[-1] < 0.1 * errors[0]) == mapped
    if mapped:
        assert (agent.model.dynamics.command.weight[:, :A] - TRUTH).abs().max() < 0.05


def test_the_neutral_action_is_made_nothing_of() -> None:
    torch.manual_seed(0)
    dynamics = Dynamics(16, 2 * A, A, 16, 8)
    assert dynamics.neutral_action() is None
    dynamics.command = command = CommandMap(3 * A, A).requires_grad_(False)
    assert torch.equal(dynamics.neutral_action(), torch.zeros(A))
    command.weight[:] = torch.cat([TRUTH, 0.5 * TRUTH, 0.1 * torch.eye(A)], 1)  # it comes late, too
    command.bias[:] = torch.tensor([0.2, -0.3])
    neutral = dynamics.neutral_action()
    assert 0.3 < neutral.abs().max() < 1
    torch.testing.assert_close(dynamics.realised(neutral.repeat(3))[:A], torch.zeros(A))
    command.bias[:] = 5.0
    assert dynamics.neutral_action().abs().max() == 1, "the limit nearest to it"
    command.weight[:] = 0.0
    assert torch.equal(dynamics.neutral_action(), torch.zeros(A)), "no command is"


def test_the_neutral_action_is_of_the_map_that_acts() -> None:
    model = make_agent(sizes={"obs_dim": 6 + 2 * A, "memory_dim": 2 * A}).model
    assert model.neutral_action() is None
    maps = [model.add_command_map(), model.add_command_band()]
    model.add_observation_map([])
    model.add_suspicion()
    for x, shift in zip([*maps, model.dynamics.joint], (0.1, 0.2, 0.3), strict=True):
        x.bias.data.fill_(shift)
    found = [model.neutral_action()]
    model.use_band(True)
    found.append(model.neutral_action())
    model.suspect(True)
    found.append(model.neutral_action())
    torch.testing.assert_close(torch.stack(found), torch.tensor([[-0.1] * A, [-0.2] * A, [-0.3] * A]))
