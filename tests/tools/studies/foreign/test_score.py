"""Scores of reports written by hand."""

import pytest

from tools.studies.foreign import score


def label(group: str, *effects: tuple[str, float], **more: object) -> dict:
    each = [
        {"name": n, "at": ["j"], "multiple": w, "weight": w, "left": w, "parameters": {"x": 1.0}} for n, w in effects
    ]
    base = {"group": group, "kind": "", "plant": "slide", "seconds": 8.0, "noise_level": 1, "force_channel": False}
    return base | {"effects": each, "equivalents": [], "alike": []} | more


def report(verdict: str, *effects: tuple[str, float], **more: object) -> dict:
    number = {"x": {"value": 1.1, "unit": "1", "low": 0.9, "high": 1.2}}
    each = [{"name": n, "at": ["j"], "share": {"value": s}, "parameters": number} for n, s in effects]
    return {"verdict": verdict, "effects": each, "candidates": [], "ties": [], "wall_seconds": 7.0, **more}


def test_the_main_effect_is_the_one_with_the_largest_share() -> None:
    truth = label("pair", ("a", 9.0), ("b", 3.0))
    assert score.main_right(report("effect", ("b", 0.1), ("a", 0.8)), truth)
    assert score.main_right(report("effect", ("a", 0.9), ("c", 0.1)), truth)
    assert not score.main_right(report("effect", ("b", 0.8), ("a", 0.1)), truth)
    assert not score.main_right(report("unknown", ("a", 0.9)), truth)


def test_what_the_equations_cannot_tell_apart_is_one_name() -> None:
    truth = label("pair", ("payload", 9.0), ("b", 3.0), equivalents=[["armature", "b"]])
    assert score.main_right(report("effect", ("armature", 0.9), ("b", 0.1)), truth)
    assert not score.main_right(report("effect", ("armature", 0.9)), label("single", ("payload", 5.0)))
    assert score.stand_ins(truth, "b", truth["equivalents"]) == {"b"}


def test_a_tie_is_right_only_among_names_that_are_alike() -> None:
    truth = label("single", ("a", 5.0), alike=[["c"]])
    tied = report("not_identifiable", ("c", 0.9), ties=[{"effects": ["a@j"]}])
    assert score.main_right(tied, truth)
    assert not score.main_right(tied, label("single", ("a", 5.0)))
    assert not score.main_right(report("not_identifiable", ("c", 0.9), ties=[{"effects": ["d"]}]), truth)
    assert not score.main_right(report("effect", ("c", 0.9)), truth)


def test_a_simpler_effect_that_does_is_right_and_another_is_not() -> None:
    truth = label("single", ("stribeck_friction", 5.0), alike=[["coulomb_friction"], ["load_dependent_friction"]])
    assert score.fair(truth)["equivalents"] == [["coulomb_friction"]]
    assert score.fair(label("single", ("coulomb_friction", 5.0), alike=[["stribeck_friction"]]))["equivalents"] == []


def test_a_median_with_its_order_statistics() -> None:
    line = score.middle("x", [float(k) for k in range(100)])
    assert (line.value, line.low, line.high, line.of) == (49.5, 40.0, 59.0, 100)


def test_the_table_counts_what_it_says() -> None:
    hidden = {
        "s1": label("single", ("a", 5.0)),
        "s2": label("single", ("a", 5.0)),
        "s3": label("single", ("a", 1.0)),  # not clear
        "p1": label("pair", ("a", 9.0), ("b", 3.0)),
        "n1": label("none"),
        "n2": label("none"),
        "o1": label("outside", ("cogging", 5.0)),
    }
    said = {
        "s1": report("effect", ("a", 0.9), held_out={"reduction": 0.8}),
        "s2": report("effect", ("a", 0.9), ("b", 0.1), held_out={"reduction": 0.6}),
        "s3": report("none"),
        "p1": report("effect", ("a", 0.9)),
        "n1": report("effect", ("b", 0.5)),
        "n2": report("none"),
        "o1": report("unknown"),
    }
    found = {line.score: (line.value, line.of) for line in score.table(said, hidden)}
    assert found["single, clear: main effect right"] == (1.0, 2)
    assert found["single, clear: exact set"] == (0.5, 2)
    assert found["pairs: F1 of the set of names"] == (pytest.approx(2 / 3), 1)
    assert found["nothing that matters: false alarms"] == (0.5, 2)
    assert found["outside the library: a wrong name"] == (0.0, 1)
    assert found["90 % intervals that cover the truth"] == (1.0, 3)
    assert found["seconds, median"] == (7.0, 7)
    row = score.row("s2", hidden["s2"], said["s2"])
    assert (row["main_right"], row["exact"], row["reduction"]) == (True, False, 0.6)
    assert score.row("n2", hidden["n2"], said["n2"])["exact"] == ""
