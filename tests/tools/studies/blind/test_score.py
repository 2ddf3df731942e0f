"""Scores of reports written by hand."""

import pytest

from tools.studies.blind import score
from tools.studies.blind.plots import confusion, power


def label(group: str, *names: str, multiple: float = 3.0, equivalents: list[list[str]] | None = None) -> dict:
    effects = [
        {"name": n, "at": ["j"], "multiple": multiple, "parameters": {"x": 1.0}, "joint": 0, "size": 1.0} for n in names
    ]
    base = {"group": group, "kind": "", "effects": effects, "equivalents": equivalents or [], "alike": []}
    return base | {"noise_level": 1, "seconds": 8.0, "plant": "slide"}


def report(verdict: str, *names: str, candidates: list[list[str]] | None = None, **more: object) -> dict:
    effects = [
        {"name": n, "at": ["j"], "parameters": {"x": {"value": 1.1, "unit": "1", "low": 0.9, "high": 1.2}}}
        for n in names
    ]
    return {"verdict": verdict, "effects": effects, "candidates": [{"effects": c} for c in candidates or []], **more}


def test_only_an_asserted_name_counts_as_named() -> None:
    truth = label("single", "coulomb_friction")
    assert score.top1(report("effect", "coulomb_friction"), truth)
    assert not score.top1(report("effect", "coulomb_friction", "payload"), truth)
    tied = report("not_identifiable", "coulomb_friction", candidates=[["payload"], ["coulomb_friction"]])
    assert not score.top1(tied, truth)
    assert score.top3(tied, truth)
    assert not score.top3(report("effect", "payload", candidates=[["a"], ["b"], ["c"], ["coulomb_friction"]]), truth)


def test_equivalent_names_are_right_and_so_is_a_tie_among_them() -> None:
    truth = label("single", "armature", equivalents=[["payload"]])
    assert score.top1(report("effect", "payload"), truth)
    assert score.top1(report("not_identifiable", ties=[["armature"], ["payload"]]), truth)
    assert score.top1(report("not_identifiable", "armature", ties=[{"effects": ["payload@carriage"]}]), truth)
    assert not score.top1(report("not_identifiable", ties=[["armature"], ["actuator_gain"]]), truth)


def test_a_tie_is_right_only_among_what_the_data_cannot_tell() -> None:
    truth = label("single", "sensor_gain") | {"alike": [["actuator_gain"]]}
    assert score.top1(report("not_identifiable", "actuator_gain", ties=[["sensor_gain"]]), truth)
    assert not score.top1(report("not_identifiable", "actuator_gain", ties=[]), truth)
    assert not score.top1(report("not_identifiable", "sensor_gain", ties=[["actuator_gain"], ["payload"]]), truth)
    assert not score.top1(report("effect", "actuator_gain"), truth)
    pair = label("pair", "sensor_gain", "deadband") | {"alike": [["actuator_gain", "deadband"]]}
    tied = report("not_identifiable", "actuator_gain", "deadband", ties=[["sensor_gain", "deadband"]])
    assert score.f1(tied, pair) == 1.0
    assert score.f1(tied, pair | {"alike": []}) == pytest.approx(2 / 3)


def test_a_conventional_name_is_honest_only_with_its_ties() -> None:
    truth = label("ambiguous", "gravity_tilt", equivalents=[["actuator_offset"]]) | {"kind": "equivalent"}
    assert score.honest(report("effect", "actuator_offset", ties=[{"effects": ["gravity_tilt"]}]), truth)
    assert not score.honest(report("effect", "actuator_offset", ties=[]), truth)
    assert not score.misled(report("effect", "actuator_offset", ties=[]), truth)
    assert score.honest(report("not_identifiable", ties=[]), truth)
    assert score.misled(report("effect", "payload", ties=[]), truth)


def test_f1_of_a_pair() -> None:
    truth = label("pair", "a", "b")
    assert score.f1(report("effect", "a", "b"), truth) == 1.0
    assert score.f1(report("effect", "a"), truth) == pytest.approx(2 / 3)
    assert score.f1(report("effect", "a", "c"), truth) == pytest.approx(1 / 2)
    assert score.f1(report("none"), truth) == 0.0
    assert score.f1(report("not_identifiable", "a", "b", ties=[["a", "c"]]), truth) == pytest.approx(2 / 3)
    assert score.f1(report("not_identifiable", "a", ties=[["c"]]), truth) == 0.0


def test_coverage_and_oracle() -> None:
    truth = label("single", "a")
    assert score.covered(report("effect", "a"), truth) == [True]
    truth["effects"][0]["parameters"]["x"] = 1.3
    assert score.covered(report("effect", "a"), truth) == [False]
    assert score.covered(report("effect", "b"), truth) == []
    held = [{"held_out": {"repaired": x}} for x in (1.1, 1.0, 1.2)]
    assert score.near_oracle(held[0], held[1]) is True
    assert score.near_oracle(held[2], held[1]) is False
    assert score.near_oracle({}, held[1]) is None


def test_the_table_counts_what_it_says() -> None:
    hidden = {
        "s1": label("single", "a", multiple=3.0),
        "s2": label("single", "a", multiple=1.0),
        "n1": label("none"),
        "n2": label("none"),
        "o1": label("outside", "cogging"),
        "x1": label("ambiguous", "a") | {"kind": "short"},
    }
    said = {
        "s1": report("effect", "a"),
        "s2": report("none"),
        "n1": report("effect", "b"),
        "n2": report("none"),
        "o1": report("unknown"),
        "x1": report("not_identifiable"),
    }
    found = {s.name: (s.hits, s.count) for s in score.table(said, hidden)}
    assert found["single, clear: top 1"] == (1, 1)
    assert found["single, all sizes: top 1"] == (1, 2)
    assert found["no effect: false alarms"] == (1, 2)
    assert found["outside the library: a wrong name"] == (0, 1)
    assert found["not identifiable: said so"] == (1, 1)
    assert found["90 % intervals that cover the truth"] == (1, 1)
    rows, columns, counts = confusion(said, hidden)
    assert counts[rows.index("a"), columns.index("a")] == 1 and counts[rows.index("a"), columns.index("none")] == 1
    assert counts[rows.index("none"), columns.index("b")] == 1 and counts.sum() == 5
    points = power(said, hidden, "plant")["slide"]
    assert [(h, n) for _, h, n in points if n] == [(0, 1), (1, 1)]
