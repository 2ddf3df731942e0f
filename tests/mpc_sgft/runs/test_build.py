"""Which pretrained agents a task takes."""

import pytest

from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.runs import build


def test_a_variant_of_a_task_takes_its_agents_and_another_task_does_not() -> None:
    cfg = compose.compose("evaluate", ["task=push_edge"], [])
    assert cfg.task.env.edge_x == pytest.approx(cfg.task.env.goal_x + cfg.task.env.tolerance)
    assert compose.compose("pretrain", ["task=push_edge"], []).randomize.draws
    _, meta = build.load_agent(cfg)
    assert meta["task"] == "push"
    with pytest.raises(UserError, match=r"no checkpoint is shipped for task 'hammer' \(shipped: push\)"):
        build.load_agent(compose.compose("evaluate", ["task=hammer"], []))
    for soft in ("push_towel", "push_ball"):
        assert (
            build.load_agent(compose.compose("deploy", [f"task={soft}", f"gap={soft}_real"], []))[1]["task"] == "push"
        )
    cfg.checkpoint, cfg.task.agents_of = str(build.shipped("push")), "pendulum"
    with pytest.raises(UserError, match="expected task='push_edge', found task='push'"):
        build.load_agent(cfg)
