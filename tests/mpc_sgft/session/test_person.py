"""What keys mean, and when; and that only somebody who is there is asked."""

import threading
import time

import numpy as np
import pytest

from envs.backends.base import BackendError
from mpc_sgft.command import compose
from mpc_sgft.command.errors import UserError
from mpc_sgft.session.operator import Nobody, again, verdict
from mpc_sgft.session.page import Page  # noqa: E402
from mpc_sgft.session.person import KEYS, Person, make_operator
from mpc_sgft.storage.rollout import Press


@pytest.fixture
def person() -> Person:
    return Person(Page(title="push sgft", rollouts=5, keys=KEYS), repeated=0.0)


def words(person: Person) -> list[tuple[str, int]]:
    return [(press.word, press.episode) for press in person.poll()]


def test_a_mark_is_about_the_last_episode_that_ran(person):
    person.heard("s")
    assert words(person) == []  # nothing ran yet
    person.enter("running", 1)
    person.heard("s")
    person.enter("resetting", 1)
    person.heard("F")
    person.enter("running", 2)
    person.heard("r")
    assert words(person) == [("success", 1), ("failure", 1), ("rerecord", 2)] and words(person) == []


def test_the_arm_is_taken_over_only_in_an_episode(person):
    person.enter("resetting", 1)
    person.heard("t")
    assert not person.halt() and words(person) == []
    person.enter("running", 2)
    person.heard("t")
    assert person.guiding and "taken over" in person.halt()
    person.heard("t")
    assert not person.guiding and not person.halt()
    person.heard("t")
    person.enter("ending", 2)
    assert not person.guiding  # the episode was over already
    assert words(person) == [("takeover", 2)] * 3


def test_a_key_that_is_held_down_does_not_undo_itself():
    person = Person(Page(title="push sgft", rollouts=5, keys=KEYS), repeated=0.3)
    person.enter("running", 1)
    for _ in range(5):  # as a terminal repeats it
        person.heard("t")
        time.sleep(0.1)
    assert person.guiding and words(person) == [("takeover", 1)]
    time.sleep(0.4)
    person.heard("t")
    assert not person.guiding


def test_nothing_moves_after_an_arm_was_handed_back_until_a_person_says_so(person):
    person.enter("running", 1)
    person.heard("t")
    assert not person.paused
    person.heard("t")
    assert person.paused and "step away" in person.page.lines()["key"]
    timer = threading.Timer(0.1, person.heard, ["p"])
    timer.start()
    person.rest()
    timer.join()
    assert not person.paused


def test_a_session_that_is_to_end_waits_for_nobody(person):
    person.heard("p")
    person.heed(lambda: True)
    person.rest()
    assert person.paused and not person.ask()
    with pytest.raises(BackendError, match="the session is to end"):
        person.place(np.zeros(3))


@pytest.mark.parametrize("key", [" ", ""], ids=["key", "terminal gone"])
def test_stop_stays(person, key):
    person.enter("running", 1)
    person.heard("t")
    person.heard(key)
    person.enter("resetting", 1)
    assert person.stopping and not person.guiding and "stop" in person.halt()


def test_a_pause_ends_by_the_same_key_or_by_stop(person):
    person.rest()  # not paused: returns
    for end in ("p", " "):
        person.heard("p")
        timer = threading.Timer(0.1, person.heard, [end])
        timer.start()
        person.rest()
        timer.join()
    assert person.stopping


def test_questions_wait_for_their_answer(person):
    person.enter("running", 3)
    for ask, keys in ((person.ask, "\nt f"), (lambda: person.place(np.array([0.4, 0.1, 0])), "s\n")):
        thread = threading.Thread(target=ask)
        thread.start()
        while person.page.lines()["now"] == "running":
            pass
        for key in keys[:-1].replace(" ", ""):
            person.heard(key)
        thread.join(0.1)
        assert thread.is_alive()  # none of these is an answer
        person.heard(keys[-1])
        thread.join(5)
        assert not thread.is_alive() and person.page.lines()["now"] == "running"


def test_stop_instead_of_placing_the_object(person):
    person.heard(" ")
    with pytest.raises(BackendError, match="stop"):
        person.place(np.zeros(3))


def test_the_last_mark_counts():
    presses = [Press("success", 0.0, 1), Press("failure", 1.0, 1), Press("success", 2.0, 2), Press("rerecord", 3.0, 2)]
    assert [verdict(presses, n) for n in (1, 2, 3)] == [False, True, None]
    assert [again(presses, n) for n in (1, 2)] == [False, True]


def test_the_page_shows_everything(person):
    from rich.console import Console

    person.watch(lambda: {"robot": "Move", "tool": "x 0.1", "object": "seen 0.1 s ago"})
    person.enter("running", 2)
    person.tell(step="3 of 40", note="limited: workspace box", successes="1 of 1")
    person.tell(note="")
    person.heard("p")
    console = Console(width=150, record=True, file=open("/dev/null", "w"))
    console.print(person.page.render())
    shown = console.export_text()
    for text in ("Move", "x 0.1", "seen 0.1 s ago", "2 of 5", "running, step 3 of 40", "workspace box", "1 of 1"):
        assert text in shown, text
    assert "pause before the next episode" in shown and "space stop" in shown
    assert list(person.track(range(3))) == [0, 1, 2] and person.page.progress is None


@pytest.mark.parametrize("given", [[], ["backend=franka"], ["backend=franka", "quiet=true"]])
def test_without_a_terminal_nobody_is_there_and_nobody_is_asked(given):
    def config(*words: str):
        return compose.compose("deploy", [*given, *words], [])

    assert isinstance(make_operator(config()), Nobody)
    with pytest.raises(UserError, match="success=ask needs a person"):
        make_operator(config("success=ask"))
