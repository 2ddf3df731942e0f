"""What a person says of the rollouts, and what follows: a mark counts, a rollout driven again does not."""

import copy
from pathlib import Path
from typing import Any, Protocol

from mpc_sgft.session.corrections import amend, forget_audit, set_aside
from mpc_sgft.session.operator import Operator, again, verdict
from mpc_sgft.storage.metrics import MetricLogger
from mpc_sgft.storage.rollout import Press, Rollout


class CountedRun(Protocol):
    """What a run of counted rollouts lets a person's word change; `runs/deploy.py` has one.

    Attributes:
        state: Its counts: rollouts, successes, rerecorded, outcomes, scores.
        transfer: What learns, with `state_dict`, `load_state_dict` and `correct`.
        metrics: Of the last rollout.
        judge: Evaluation episodes on the side; None where the real rollouts are the measure.
        viewer: Shows the rollouts that count; None: nothing does.
    """

    folder: Path
    state: dict[str, Any]
    transfer: Any
    metrics: dict[str, float]
    judge: Any
    viewer: Any
    operator: Operator
    logger: MetricLogger

    def path(self, number: int) -> Path: ...

    def save(self) -> None: ...

    def show_counts(self) -> None: ...

    def make_logger(self, resume_step: int | None) -> MetricLogger: ...

    def evaluate(self, table: Any, metrics: dict[str, float]) -> None: ...


class Verdicts:
    """Takes keys about a rollout while it is the last one, up to the next one's first step.

    Args:
        run: Whose rollouts.
        ask: Whether a person is asked about each one that came to its end.
    """

    def __init__(self, run: CountedRun, *, ask: bool):
        self.run, self.ask = run, ask
        self._before: dict[str, Any] | None = None  # everything, as it was before the last rollout counted
        self._heard: list[Press] = []

    def remember(self) -> None:
        """Keep what there is, so that the next rollout can be undone."""
        run = self.run
        self._before = copy.deepcopy({"loop": run.state, "transfer": run.transfer.state_dict(), "metrics": run.metrics})

    def of(self, rollout: Rollout, number: int) -> Rollout | None:
        """A rollout that does not count yet, with what a person says of it; None if it does not count now.

        Then it is to be driven again, or nobody said what they were asked, because the session ends.
        """
        self.late(number - 1)
        known, heard, answered = list(rollout.keys), self._take(number), True
        said = verdict([*known, *heard], number)
        if self.ask and rollout.aborted is None and said is None and not again([*known, *heard], number):
            answered = self.run.operator.ask()
            heard += self._take(number)
            said = verdict([*known, *heard], number)
        path = self.run.path(number)
        if heard or (said is not None and said != rollout.success):
            amend(path, heard, said)
        if again([*known, *heard], number):
            self.run.state["rerecorded"] += 1
            set_aside(path)
            self.run.save()
            self.run.show_counts()
            return None
        if not answered:
            return None  # it is recorded, and asked about when the session goes on
        return rollout if said is None else rollout._replace(success=said)

    def again(self, number: int) -> bool:
        """Whether the last rollout was undone now, because it is to be driven again; marks wait until there is time."""
        self._heard += self.run.operator.poll()
        return again(self._heard, number) and self.late(number)

    def late(self, number: int) -> bool:
        """Do what was asked about a rollout that counted already; whether it was undone."""
        heard = self._take(number)
        if not heard or not number or self.run.state["rollouts"] != number:
            return False
        said, redo = verdict(heard, number), again(heard, number)
        amend(self.run.path(number), heard, said)
        if redo and self._before is None:
            self.run.operator.tell(note=f"rollout {number} was counted before this session: it stays")
        elif redo:
            self._undo(number)
            return True
        if said is not None:
            self._correct(number, said)
        return False

    def _take(self, number: int) -> list[Press]:
        """Keys about a rollout, or an earlier one; later ones wait."""
        self._heard += self.run.operator.poll()
        taken = [press for press in self._heard if press.episode <= number]
        self._heard = [press for press in self._heard if press.episode > number]
        return taken

    def _undo(self, number: int) -> None:
        """Forget a rollout and what was learned from it; its file is kept under another name."""
        run, before = self.run, self._before
        assert before is not None
        before["loop"]["rerecorded"] = run.state["rerecorded"] + 1
        run.state, run.metrics, self._before = before["loop"], before["metrics"], None
        run.transfer.load_state_dict(before["transfer"])
        run.save()  # first: if the process is killed here, the recording is there and counts
        set_aside(run.path(number))
        forget_audit(run.folder / "audit.csv", number)
        if run.viewer:
            run.viewer.correct(None)
        run.logger.close()
        run.logger = run.make_logger(number - 1)
        run.show_counts()

    def _correct(self, number: int, success: bool) -> None:
        """Count the last rollout as a person marked it."""
        run = self.run
        outcomes = run.state["outcomes"]
        outcomes[-1] = (success, outcomes[-1][1])
        run.state["successes"] = sum(s for s, _ in outcomes)
        run.transfer.correct(number, success)
        if run.viewer:
            run.viewer.correct(success)
        measured = dict[str, float]()
        if run.judge is None and run.state["scores"].pop(number, None) is not None:
            run.evaluate(None, measured)
        if run.metrics:  # those of a rollout that an earlier process counted are not known any longer
            run.metrics |= measured | {"real_success": float(success)}
            run.logger.close()
            run.logger = run.make_logger(number - 1)
            run.logger.log(number, run.metrics)
        run.save()
        run.show_counts()
