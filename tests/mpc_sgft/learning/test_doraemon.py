"""Randomisation widens as far as success allows, by steps that it may take, and no further."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.stats import beta
from torch import Tensor
from torch.distributions import Beta, kl_divergence

from mpc_sgft.learning.doraemon import Doraemon

SETTINGS = {"success": 0.5, "trust": 1.0, "concentration": 20.0, "episodes": 400}


def after(changes: int, succeeds: Callable[[Tensor], Tensor], **changed) -> Doraemon:
    """What so many changes make of two draws, if episodes succeed as told."""
    found, rng = Doraemon(2, **SETTINGS | changed), np.random.default_rng(0)
    for _ in range(changes):
        places = torch.from_numpy(rng.beta(*found.shapes.T.numpy(), size=(found.episodes, 2)))
        found.record(places, succeeds(places), found.shapes.tolist())
    return found


def test_where_everything_succeeds_the_whole_ranges_are_drawn() -> None:
    found = after(6, lambda x: torch.ones(len(x), dtype=torch.bool))
    torch.testing.assert_close(found.shapes, torch.ones(2, 2, dtype=torch.float64), atol=0.02, rtol=0)
    assert abs(found.entropy) < 1e-3, "uniform over a range of length 1"


def test_it_widens_until_as_many_fail_as_may_and_only_where_they_do() -> None:
    """The first draw must stay below 0.6, the second does not matter: the most random one there is can be computed."""
    found = after(25, lambda x: x[:, 0] < 0.6, success=0.9)
    (a, b), free = found.shapes.tolist()
    np.testing.assert_allclose(free, [1, 1], atol=0.1)
    assert abs(beta.cdf(0.6, a, b) - 0.9) < 0.03
    p, q = np.meshgrid(np.linspace(1, 6, 101), np.linspace(1, 6, 101))
    most = beta.entropy(p, q)[beta.cdf(0.6, p, q) >= 0.9].max()
    assert abs(found.entropy - most) < 0.05, (a, b, most)


def test_one_change_goes_as_far_as_it_is_trusted() -> None:
    start = Doraemon(2, **SETTINGS).shapes
    for trust in (0.3, 1.0):
        found = after(1, lambda x: torch.ones(len(x), dtype=torch.bool), trust=trust)
        moved = kl_divergence(Beta(*found.shapes.T), Beta(*start.T)).sum()
        assert float(moved) == pytest.approx(trust, abs=1e-4)


def test_too_many_failures_bring_it_back_to_where_episodes_succeed() -> None:
    wide = {"concentration": 2.0, "success": 0.9, "episodes": 4000}  # a chance within half a percent
    before, found = after(0, lambda x: x[:, 0] < 0.3, **wide), after(8, lambda x: x[:, 0] < 0.3, **wide)
    chance = [beta.cdf(0.3, *d.shapes[0].tolist()) for d in (before, found)]
    assert chance[0] == pytest.approx(0.3) and chance[1] > 0.87


def test_hopeless_episodes_change_nothing() -> None:
    found = after(2, lambda x: torch.zeros(len(x), dtype=torch.bool))
    torch.testing.assert_close(found.shapes, Doraemon(2, **SETTINGS).shapes)


def test_episodes_of_an_older_distribution_count_by_how_likely_they_are_now() -> None:
    """All were drawn uniformly, half of them succeed: the present distribution, and any other, is judged by them."""
    found = Doraemon(1, success=0.8, trust=50.0, concentration=60.0, episodes=4000)
    places = torch.from_numpy(np.random.default_rng(1).random((4000, 1)))
    found.record(places, (places[:, 0] - 0.5).abs() < 0.25, [[1.0, 1.0]])
    chance = np.diff(beta.cdf([0.25, 0.75], *found.shapes[0].tolist()))
    assert chance[0] == pytest.approx(0.8, abs=0.02)


def test_rounds_add_up_count_once_and_leave_out_what_tells_nothing() -> None:
    found, torn = Doraemon(1, **SETTINGS | {"episodes": 6}), torch.tensor([[0.5], [torch.nan], [0.4], [0.6]])
    won = torch.ones(4, dtype=torch.bool)
    first = found.record(torn, won, found.shapes.tolist())["randomize_entropy"]
    assert first == pytest.approx(float(beta.entropy(10, 10))), "three of six episodes"
    again = Doraemon(1, **SETTINGS | {"episodes": 6})
    again.load_state_dict(found.state_dict())
    wider = [one.record(torn, won, one.shapes.tolist())["randomize_entropy"] for one in (found, again)]
    assert wider[0] == wider[1] > first + 0.3
    assert found.record(torn, won, found.shapes.tolist())["randomize_entropy"] == wider[0], "three of the next six"


@pytest.mark.parametrize(
    ("draws", "changed", "message"),
    [
        (0, {}, "nothing is randomised"),
        (1, {"success": 1.0}, "success=1.0"),
        (1, {"trust": 0.0}, "trust=0.0 must be above 0"),
        (1, {"concentration": 1.0}, "concentration=1.0 between 2"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(draws: int, changed: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Doraemon(draws, **SETTINGS | changed)
