"""Turns drawn cases into data; another case is drawn in place of one whose effects cannot be made large enough."""

from collections import defaultdict
from collections.abc import Callable

from tools.studies.blind.batch import Batch
from tools.studies.blind.draw import Case, redraw
from tools.studies.blind.made import PLAIN, Ground, Made

ATTEMPTS = 6  # to draw a case whose effects can be made large enough


def make(cases: list[Case], progress: Callable[[float], object] = lambda n: None, ground: Ground = PLAIN) -> list[Made]:
    """All cases, in their order. Those of one plant are simulated together.

    Args:
        cases: As `draw.draw` gives them.
        progress: Called with the number of cases, or parts of them, that were finished; negative for those that have
            to be made anew.
        ground: What else reality has.
    """
    done: dict[str, Made] = {}
    todo = list(cases)
    for attempt in range(1, ATTEMPTS + 1):
        batches: dict[str, list[Case]] = defaultdict(list)
        for case in todo:
            batches[case.plant].append(case)
        todo = []
        for batch in batches.values():
            count = len(batch)
            finished = Batch(batch, ground).finish(
                attempt == ATTEMPTS, lambda share, count=count: progress(share * count)
            )
            for case, made in zip(batch, finished, strict=True):
                if made is None:
                    todo.append(redraw(case, attempt, ground.mix))
                    progress(-1)
                else:
                    done[case.name] = made
    return [done[case.name] for case in cases]
