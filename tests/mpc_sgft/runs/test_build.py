"""Which pretrained agents a task takes."""

import pytest

from mpc_sgft.api import configure, make_env, measure
from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build


def test_a_variant_of_a_task_takes_its_agents_and_another_task_does_not() -> None:
    cfg = compose.compose("evaluate", ["task=push_edge"], [])
    assert cfg.task.env.edge_x == pytest.approx(cfg.task.env.goal_x + cfg.task.env.tolerance)
    assert compose.compose("pretrain", ["task=push_edge"], []).randomize.draws
    _, meta = build.load_agent(cfg)
    assert meta["task"] == "push"
    have = r"\(shipped: hammer, insert, push, rope_peg_in_hole, walker_walk\)"
    with pytest.raises(UserError, match=f"no checkpoint is shipped for task 'pendulum' {have}"):
        build.load_agent(compose.compose("evaluate", ["task=pendulum"], []))
    for soft in ("push_towel", "push_ball"):
        assert (
            build.load_agent(compose.compose("deploy", [f"task={soft}", f"gap={soft}_real"], []))[1]["task"] == "push"
        )
    cfg.checkpoint, cfg.task.agents_of = str(build.shipped("push")), "pendulum"
    with pytest.raises(UserError, match="expected task='push_edge', found task='push'"):
        build.load_agent(cfg)


@pytest.mark.parametrize("task", ["hammer", "insert", "rope_peg_in_hole", "walker_walk"])
def test_a_shipped_agent_does_its_task_and_knows_the_range_of_its_values(task: str) -> None:
    cfg = compose.compose("evaluate", [f"task={task}"], [])
    agent, meta = build.load_agent(cfg)
    assert agent.model.value_range == meta["value_range"] > 1
    assert measure(cfg, agent, episodes=8).success >= 0.85


def test_a_simulated_reality_rewards_what_is_observed_where_that_is_asked_for() -> None:
    for name, given, believes in (
        ("deploy", ["backend.reward=observed"], True),
        ("deploy", [], False),
        ("pretrain", [], False),
    ):
        assert build.make_env(compose.compose(name, given, []), 1).backend.believes is believes
    with pytest.raises(UserError, match="^simulation: backend.reward='seen'; allowed: truth, observed"):
        build.make_env(compose.compose("evaluate", ["backend.reward=seen"], []), 1)


def test_a_draw_that_is_null_is_left_out() -> None:
    cfg = compose.compose("pretrain", ["task=push", "randomize.draws.mass=null"], [])
    assert set(build.draws_of(cfg)) == set(cfg.randomize.draws) - {"mass"}


@pytest.mark.parametrize(("word", "command"), [("device=gpu", "deploy"), ("policy=rndom", "evaluate")])
def test_a_config_from_python_has_only_words_that_exist(word: str, command: str) -> None:
    with pytest.raises(UserError, match=f"unknown {word.partition('=')[0]}"):
        configure(word, command=command)


def test_from_python_environments_draw_what_the_command_draws() -> None:
    def drawn(*words: str, command: str) -> int:
        env = make_env(configure("task=push", *words, command=command), 3)
        env.set_seed(0)
        env.reset()
        return len({tuple(row) for row in env.backend.randomizer.places.tolist()})

    assert drawn("randomize=push", command="evaluate") == drawn(command="pretrain") == 3
    assert drawn(command="evaluate") == drawn(command="deploy") == 1
