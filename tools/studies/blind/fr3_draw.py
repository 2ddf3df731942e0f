"""Which cases of the FR3 there are, from one seed; as `draw` does for the other machines."""

import numpy as np

from tools.studies.blind.draw import INERTIAL, MULTIPLE, NOISE, SHARES, UNCERTAIN, WRONG, Case, Given, given, pair
from tools.studies.blind.fr3 import NUMERICS
from tools.studies.blind.library import OUTSIDE_SITES, SITES

SECONDS = (2.0, 8.0)
LEAST = {"single": MULTIPLE[0], "pair": 1.5, "outside": 3.0, "ambiguous": MULTIPLE[0]}  # smallest multiple
WITH_FORCE = {"actuator_delay", "actuator_offset", "actuator_gain", "joint_stiffness"}  # told by force alone


def draw(seed: int, count: int, first: int = 0) -> list[Case]:
    """The FR3 cases of a seed, in an order that says nothing.

    Args:
        seed: Of everything.
        count: How many.
        first: Number in the name of the first; cases of other plants come before.

    Raises:
        ValueError: If count is negative.
    """
    if count < 0:
        raise ValueError(f"fr3={count}: 0 or more cases of the FR3 can be made")
    edges = np.round(np.cumsum(list(SHARES.values())) * count).astype(int)
    groups = [name for name, n in zip(SHARES, np.diff(edges, prepend=0), strict=True) for _ in range(n)]
    ranks = {name: 0 for name in SHARES}
    cases = []
    for i, where in enumerate(np.random.default_rng((seed, 2718, 7)).permutation(len(groups))):
        group = groups[where]
        cases.append(_case(first + i, group, ranks[group], seed, 0))
        ranks[group] += 1
    return cases


def redraw(case: Case, attempt: int) -> Case:
    """Another case of the same group in place of one whose effect cannot reach its smallest size."""
    seed, index, rank = case.entropy[:3]
    return _case(index, case.group, rank, seed, attempt)


def _case(index: int, group: str, rank: int, seed: int, attempt: int) -> Case:
    entropy = (seed, index, rank, attempt, 7)
    rng = np.random.default_rng((*entropy, 1))
    seconds, kind, sites = float(rng.choice(SECONDS)), "", SITES["fr3"]
    effects: tuple[Given, ...] = ()
    if group == "single":
        effects = (given(str(rng.choice(sorted(sites))), sites, rng, MULTIPLE),)
    elif group == "pair":
        effects = tuple(given(n, sites, rng, (LEAST[group], MULTIPLE[1])) for n in pair("fr3", rng))
    elif group == "outside":
        options = OUTSIDE_SITES["fr3"]
        effects = (given(sorted(options)[rank % len(options)], options, rng, (LEAST[group], MULTIPLE[1])),)
        seconds = SECONDS[-1]
    elif group == "ambiguous":
        kind = ("equivalent", "short")[rank % 2]
        options = ("actuator_gain", "actuator_offset", "sensor_offset") if kind == "equivalent" else sorted(sites)
        least = (2.0, MULTIPLE[1]) if kind == "equivalent" else (MULTIPLE[0], 2.0)
        effects = (given(str(rng.choice(options)), sites, rng, least),)
        seconds = 0.6 if kind == "short" else seconds
    names = {e.name for e in effects}
    wrong: dict[str, float] = {}
    if (group == "none" and rank % 2 == 0) or (
        group in ("single", "pair") and not names & INERTIAL and rng.uniform() < 0.25
    ):
        wrong = {"mass": 1 + float(rng.uniform(*WRONG)) * (1 if rng.uniform() < 0.5 else -1)}
    careful = not wrong and not names & INERTIAL and rng.uniform() < 0.2
    return Case(
        name=f"case_{index:04d}",
        group=group,
        kind=kind,
        plant="fr3",
        seconds=seconds,
        noise=int(rng.integers(len(NOISE["hinge"]))),
        jitter=bool(rng.uniform() < 0.5),
        speed_channel=bool(rng.uniform() < 0.3),
        force_channel=(bool(rng.uniform() < 0.3) or bool(names & WITH_FORCE)) and group != "ambiguous",
        nominal={"link": f"link{rng.integers(1, 8)}", "numerics": int(rng.integers(len(NUMERICS)))},
        wrong=wrong,
        uncertain={"mass": UNCERTAIN} if wrong or careful else {},
        effects=effects,
        entropy=entropy,
    )
