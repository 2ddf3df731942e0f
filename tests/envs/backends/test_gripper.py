"""The real client against the stand-in's hand: it holds the tool, says what is wrong, and never lets go by itself.

The stand-in's fingers stop at the width they are sent to, tool or no tool; too little force leaves them where they are.
"""

from collections.abc import Callable

import pytest

from envs.backends.base import BackendError
from envs.backends.gripper import NEAR, Gripper
from envs.stand_in.client import StandIn

TOOL = 0.02  # [m] the peg of push
NOTHING = 1e-6  # [N] that moves no finger


@pytest.fixture
def hand(stand_in: StandIn) -> Callable:
    """hand(): the client's own gripper, to do what Gripper would not; one client at a time."""
    import franky

    return lambda: franky.Gripper(stand_in.ip)


def test_a_session_begins_with_the_tool_in_hand_and_notices_its_loss(stand_in: StandIn, on_stand_in) -> None:
    robot = on_stand_in(stand_in, width=TOOL)
    gripper = robot.rig.gripper
    assert robot.status()["gripper"].startswith("holds, fingers 2")
    gripper.hold(stand_in.ip, moves=True)  # the next episode: it looks, and nothing else
    assert gripper._hand.is_grasped and abs(gripper._hand.width - TOOL) < NEAR
    gripper._hand.open(0.1)  # somebody pulls the tool out
    with pytest.raises(BackendError, match=r"lost the tool \(holds nothing, fingers 7.*Put the tool between"):
        robot.rig.open()


def test_a_tool_in_hand_is_left_alone_and_a_dry_run_moves_no_finger(stand_in: StandIn, hand) -> None:
    dry = Gripper(TOOL, 0.05, 40.0)
    dry.hold(stand_in.ip, moves=False)
    assert dry.words == "holds nothing, fingers 40.0 mm apart"
    dry.close()
    other = hand()
    other.grasp(TOOL, 0.05, 40.0)
    del other
    weak = Gripper(TOOL, 0.05, NOTHING)  # could not grasp it
    weak.hold(stand_in.ip, moves=True)
    assert weak.words.startswith("holds, fingers 2")


def test_a_hand_that_does_not_get_there_says_so(stand_in: StandIn, hand) -> None:
    wide = Gripper(0.10, 0.05, 40.0)
    with pytest.raises(
        BackendError, match="opens to 0.07. m, not to backend.gripper.width=0.1 m"
    ):  # homed, to find out
        wide.hold(stand_in.ip, moves=True)
    wide.close()
    weak = Gripper(TOOL, 0.05, NOTHING)
    with pytest.raises(BackendError, match="does not hold a tool .*fingers 4.* mm apart.*Put the tool between"):
        weak.hold(stand_in.ip, moves=True)  # wider than the tool: it may be there, and nothing opens
    weak.close()
    other = hand()
    other.move(0.005, 0.05)
    del other
    empty = Gripper(TOOL, 0.05, NOTHING)
    with pytest.raises(BackendError, match=r"fingers [567]\.. mm apart, now 7.* mm"):  # nothing is in it: opened for it
        empty.hold(stand_in.ip, moves=True)


def test_nobody_there_or_gone(stand_in: StandIn) -> None:
    with pytest.raises(BackendError, match="no gripper answers at 127.77.77.77.*backend.gripper.width=null"):
        Gripper(TOOL, 0.05, 40.0).hold("127.77.77.77", moves=True)
    Gripper(None, 0.05, 40.0).hold("127.77.77.77", moves=True)  # no gripper: nobody is asked
    held = Gripper(TOOL, 0.05, 40.0)
    held.hold(stand_in.ip, moves=True)
    stand_in.process.kill()
    stand_in.process.wait()
    with pytest.raises(BackendError, match="connection to the gripper at .* was lost"):
        held.hold(stand_in.ip, moves=True)


@pytest.mark.parametrize(("width", "speed", "force"), [(0, 0.05, 40), (-1, 0.05, 40), (0.02, 0.2, 40), (0.02, 0.05, 0)])
def test_numbers_that_cannot_be(width: float, speed: float, force: float) -> None:
    with pytest.raises(ValueError, match="above 0"):
        Gripper(width, speed, force)
