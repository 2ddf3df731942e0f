"""The entry from elsewhere says what it needs; it is run by hand, since the tests do not bring stable-baselines3."""

import sys

import pytest

from tools.studies import enter_sb3


def test_without_stable_baselines3_it_says_how_to_get_it(monkeypatch, capsys, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(SystemExit):
        enter_sb3.main([str(tmp_path / "x.csv"), "--gaps", "push-turned"])
    assert "mpc_sgft[sb3]" in capsys.readouterr().err
