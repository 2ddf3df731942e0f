"""The observation map finds what the sensors should have said, and is the identity until then."""

import math

import pytest
import torch
from torch import Tensor

from mpc_sgft.learning.dynamics import Dynamics
from mpc_sgft.learning.fit import Maps, Penalty, Suspicion, fit_dynamics
from mpc_sgft.learning.observation_map import ObservationMap, Sensed
from mpc_sgft.learning.slices import Slices
from mpc_sgft.storage import checkpoint
from tests.mpc_sgft.learning.agents import make_agent

NAMES = ("tip_x", "tip_y", "height", "puck_x", "puck_y", "roll_x")


def test_points_are_pairs_of_an_x_and_a_y():
    assert Sensed(NAMES, torch.zeros(1, 6)).points() == [[0, 1], [3, 4]]


def test_a_fresh_map_changes_no_bit_and_one_by_hand_turns_and_shifts():
    centre, unit = torch.tensor([1.0, 2.0, 5.0]), torch.tensor([0.1, 0.2, 0.5])
    sensors = ObservationMap([[0, 1]], centre, unit, blocks=2)
    observation = torch.tensor([[2.0, 2.0, 7.0, 1.0, 3.0, 8.0, 0.3, -0.4]])  # two blocks of three, then past actions
    assert torch.equal(sensors(observation), observation)
    with torch.no_grad():
        sensors.turn.fill_(math.pi / 2)
        sensors.doubted.fill_(1.0)
        sensors.shift.copy_(torch.tensor([1.0, 0.0, -2.0]))
    wanted = torch.tensor([[1.1, 3.0, 6.0, 0.1, 2.0, 7.0, 0.3, -0.4]])
    assert torch.allclose(sensors(observation), wanted, atol=1e-6)
    assert sensors.size().item() == pytest.approx((math.pi / 2) ** 2 + 5)


def test_starts_count_as_far_as_they_lie_outside_the_simulated_ones():
    sensors = ObservationMap([], torch.zeros(2), torch.tensor([0.5, 2.0]), blocks=1)
    starts = torch.tensor([[0.5, 0.0], [2.0, -4.0]])  # one inside; one a unit and a unit and a half outside
    low, high = torch.tensor([0.0, -1.0]), torch.tensor([1.5, 1.0])
    assert sensors.outside(starts, low, high).item() == pytest.approx((1.0**2 + 2 * 1.5 - 1) / 2)


def test_only_what_starts_elsewhere_is_corrected_and_points_turn_together():
    sensors = ObservationMap([[0, 1]], torch.zeros(4), torch.ones(4), blocks=1)
    with torch.no_grad():
        sensors.turn.fill_(math.pi)
        sensors.shift.fill_(0.5)
    starts, low, high = torch.zeros(2, 4), -torch.ones(4), torch.ones(4)
    observation = torch.ones(1, 4)
    sensors.doubt(starts, low, high, 0.01)
    assert torch.equal(sensors(observation), observation)
    starts[0, 2] = 1.2  # 0.2 outside, once: 0.04 in sum
    sensors.doubt(starts, low, high, 0.05)
    assert torch.equal(sensors(observation), observation)
    sensors.doubt(starts, low, high, 0.03)
    assert sensors(observation).tolist() == [[1.0, 1.0, 1.5, 1.0]]
    starts = torch.cat([starts, torch.zeros(20, 4)])  # many within take nothing back
    sensors.doubt(starts, low, high, 0.03)
    assert sensors(observation).tolist() == [[1.0, 1.0, 1.5, 1.0]]
    starts[1, 0] = -2.0
    sensors.doubt(starts, low, high, 0.03)
    assert torch.allclose(sensors(observation), torch.tensor([[-0.5, -1.0, 1.5, 1.0]]), atol=1e-6)


def test_what_is_suspected_corrects_where_it_is_believed_and_not_small():
    sensors = ObservationMap([[0, 1]], torch.zeros(4), torch.tensor([1.0, 1.0, 2.0, 1.0]), blocks=1)
    with torch.no_grad():
        sensors.turn.fill_(math.pi)
        sensors.shift.copy_(torch.tensor([0.5, 0.08, -0.2, 0.3]))  # 0.1 is small
        sensors.doubted[3] = 1.0
    seen = torch.zeros(1, 4)
    torch.testing.assert_close(sensors(seen), torch.tensor([[0.0, 0.0, 0.0, 0.3]]))
    sensors.suspects.fill_(True)
    torch.testing.assert_close(sensors(seen), torch.tensor([[0.5, 0.0, -0.4, 0.3]]))
    torch.testing.assert_close(sensors(seen, suspected=False), torch.tensor([[0.0, 0.0, 0.0, 0.3]]))
    suspected = sensors(seen, suspected=True)
    torch.testing.assert_close(suspected, torch.tensor([[0.5, 0.08, -0.4, 0.3]]))
    suspected.sum().backward()  # doubted entries learn by what acts
    assert sensors.shift.grad.tolist() == [1.0, 1.0, 2.0, 0.0]
    assert sensors.suspicion().item() == pytest.approx(0.78)
    assert sensors.size().item() == pytest.approx(math.pi**2 + 0.3**2)
    box = (
        torch.full((4,), -0.1),
        torch.full((4,), 0.1),
    )  # suspected starts lie outside by 0.4, 0, 0.3 / 2 and 0.2 spreads
    assert sensors.outside(seen, *box, suspected=True).item() == pytest.approx(0.4**2 + 0.15**2 + 0.2**2)


@pytest.mark.parametrize("suspected", [True, False, None])
def test_the_turn_learns_nothing_by_a_suspicion(suspected: bool | None):
    sensors = ObservationMap([[0, 1]], torch.zeros(2), torch.ones(2), blocks=1)
    sensors.doubted[0] = 1.0
    sensors(torch.tensor([[1.0, 2.0]]), suspected=suspected).sum().backward()
    assert (sensors.turn.grad is None) == (suspected is True)


class Slope(Dynamics):
    """A puck that moves less the farther out it lies: so what it does tells where it is."""

    def next(self, z: Tensor, commands: Tensor, realised: Tensor) -> Tensor:
        return z + 0.3 * realised / (1 + 4 * z.square())


class Rest(Dynamics):
    """Nothing moves, and nothing tells where it is."""

    def next(self, z: Tensor, commands: Tensor, realised: Tensor) -> Tensor:
        return z.detach()


@pytest.mark.parametrize("told", ["by dynamics", "by starts", "by suspicion"])
def test_a_shifted_sensor_is_found(told: str):
    """Observations, here their own latents, lie 0.3 and -0.2 beside the truth."""
    agent = make_agent(sizes={"obs_dim": 2, "decode_dim": 2})
    model, offset = agent.model, torch.tensor([0.3, -0.2])
    model.add_observation_map([[0, 1]])
    agent.train_only(("dynamics", "observation_map"), lr=1e-3, policy_lr=1e-3, observation_lr=5e-3)
    sensors = model.observation_map
    sensors.doubted.fill_(told != "by suspicion")
    model.encode_corrected = lambda o: o
    model.dynamics.next = lambda z, commands, realised: z + 0 * model.dynamics.base[0].linear.bias.sum()
    generator = torch.Generator().manual_seed(0)
    starts = torch.tensor([[0.0, 0.0], [0.1, 0.1]]) + offset

    def doubt() -> Tensor:
        if told != "by starts":
            return 0.0 * sensors.size()
        return sensors.outside(starts, torch.zeros(2), torch.full((2,), 0.1))

    sizes = {"code_dim": 2, "memory_dim": 0, "action_dim": 2, "mlp_dim": 2, "simnorm_dim": 2}
    truth = Slope(**sizes)
    own = Rest(**sizes) if told == "by starts" else truth
    suspicion = Suspicion((sensors.shift,), own) if told == "by suspicion" else None
    for _ in range(400):
        action = 2 * torch.rand(4, 64, 2, generator=generator) - 1
        z = [2 * torch.rand(64, 2, generator=generator) - 1]
        for a in action:
            z.append(truth(z[-1], a))
        nothing = torch.zeros(4, 64)
        data = Slices(torch.stack(z) + offset, action, nothing, nothing.bool())
        maps = Maps((sensors,), own, (Penalty("doubt", 1.0, doubt),), suspicion=suspicion)
        fit_dynamics(agent, data, rho=1.0, maps=maps)
    if suspicion:  # which has corrected nothing so far
        assert torch.equal(model.encode(data.observation), data.observation)
        sensors.suspects.fill_(True)
        assert torch.allclose(model.encode(data.observation), torch.stack(z), atol=0.02)
    assert torch.allclose(sensors.shift * sensors.unit, -offset, atol=0.02)
    assert abs(sensors.turn.item()) < 0.05


def test_a_map_is_saved_with_its_model(tmp_path):
    agent = make_agent()
    agent.model.add_observation_map([[0, 1]])
    with torch.no_grad():
        agent.model.observation_map.turn.fill_(0.3)
        agent.model.observation_map.doubted[0] = 1.0
    meta = {"format": checkpoint.FORMAT, "task": "push", "sizes": agent.model.sizes, "observation_map": [[0, 1]]}
    checkpoint.save(tmp_path / "m.safetensors", agent.model, meta)
    loaded = checkpoint.load(tmp_path / "m.safetensors").model
    seen = torch.randn(3, 6)
    assert torch.equal(loaded.encode(seen), agent.model.encode(seen))
    with pytest.raises(ValueError, match="already"):
        loaded.add_observation_map([])
