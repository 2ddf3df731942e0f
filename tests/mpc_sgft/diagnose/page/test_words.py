"""What is said in plain words holds the numbers, their units and the place."""

from __future__ import annotations

import pytest

from mpc_sgft.diagnose.candidates.effect_facts import effect_class, possible
from mpc_sgft.diagnose.page.words import SAYS, changes, headline, sentence

HELD = {"signal": "qpos/elbow", "unit": "rad", "nominal": 0.05, "repaired": 0.001}


def row(name: str, at: list[str], **parameters: tuple[float, str]) -> dict:
    return {
        "name": name,
        "at": at,
        "parameters": {n: {"value": x, "unit": unit} for n, (x, unit) in parameters.items()},
    }


@pytest.mark.parametrize("name", possible())
def test_every_effect_has_a_sentence_that_stands_for_itself(name: str) -> None:
    kind = effect_class(name)
    effect = row(name, ["elbow"], **{p: (0.123, "rad") for p in kind.units})
    assert name in SAYS and "0.123" in sentence(effect)
    assert "elbow" in sentence(effect) or not kind.place


def test_numbers_without_words_of_their_own_keep_their_signs() -> None:
    effect = row("actuator_offset", [], offset_1=(0.05, "rad"), offset_2=(-0.08, "rad"))
    assert sentence(effect).endswith(": offset_1 0.05 rad, offset_2 -0.08 rad")


def test_signs_and_units_are_words() -> None:
    assert sentence(row("payload", ["forearm"], mass=(0.28, "kg"))) == "body forearm carries 0.28 kg more"
    assert sentence(row("payload", ["forearm"], mass=(-0.28, "kg"))) == "body forearm carries 0.28 kg less"
    friction = row("viscous_friction", ["elbow"], coefficient=(-0.5, "N m s/rad"))
    assert sentence(friction) == "joint elbow has 0.5 N m s/rad less viscous friction"
    both = sentence(row("actuator_gain", ["m1", "m2"], gain=(0.9, "1")))
    assert both.startswith("each of the actuators m1, m2 exerts 0.9 times")


def test_an_effect_that_has_no_sentence_is_told_by_its_numbers() -> None:
    assert sentence(row("state_torque", [], amplitude=(2.0, "N m"))) == "state torque at the scene: amplitude 2 N m"


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        (
            "effect",
            "The model lacks this: body forearm carries 0.28 kg more. With that in it, the error of qpos/elbow falls",
        ),
        ("not_identifiable", "Or it is armature@elbow: these data cannot tell."),
        ("none", "Nothing that matters is missing: within noise (0.05 rad of qpos/elbow)."),
        ("unknown", "Something is missing that no name in the library covers: within noise."),
    ],
)
def test_the_headline_says_the_verdict(verdict: str, words: str) -> None:
    effects = [row("payload", ["forearm"], mass=(0.28, "kg"))] if verdict in ("effect", "not_identifiable") else []
    ties = [{"effects": ["armature@elbow"]}]
    said = headline({"verdict": verdict, "reason": "within noise", "effects": effects, "ties": ties, "held_out": HELD})
    assert words in said


def test_an_error_that_nothing_explains_is_not_called_nothing() -> None:
    reason = "no name and no flexible model explains the error, 183.0 times noise and floor"
    said = headline({"verdict": "none", "reason": reason, "effects": [], "ties": [], "held_out": HELD})
    assert said == f"Nothing is named: {reason} (0.05 rad of qpos/elbow)."


def test_signals_that_move_most_come_first_and_those_that_rest_not_at_all() -> None:
    moved = [("a", 0.0), ("b", 0.1), ("c", 0.5), ("d", 0.01), ("e", 0.2)]
    effect = {"changes": [{"signal": n, "unit": "rad", "rms": x} for n, x in moved]}
    assert changes(effect) == ["c by 0.5 rad", "e by 0.2 rad", "b by 0.1 rad"]


def test_an_effect_without_a_place_is_everywhere() -> None:
    assert sentence(row("actuator_delay", [], delay=(0.2, "s"))) == "commands of every actuator arrive 0.2 s late"
