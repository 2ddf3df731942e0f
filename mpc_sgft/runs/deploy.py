"""The deployment loop: drive a real rollout, record it, learn from it, measure, show, save. Nothing real is lost."""

import json
import sys
import time
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from envs.backends.base import BackendError
from envs.env import ControlEnv
from mpc_sgft.command.errors import Stopped, UserError, disk_errors
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.audit import audit, write_audit
from mpc_sgft.learning.transfer import open_loop_error
from mpc_sgft.learning.world_model import WorldModel
from mpc_sgft.runs import build, robot
from mpc_sgft.runs.collect import Score, collect, planner_policy, score, score_of, shown
from mpc_sgft.runs.fine_tuning import make_transfer
from mpc_sgft.runs.pretrain import StopRequest, Stopwatch, evaluation_seed
from mpc_sgft.runs.real_rollout import begin, drive, start_seed
from mpc_sgft.session import person
from mpc_sgft.session.corrections import forget_audit
from mpc_sgft.session.keyboard import ending_in_order
from mpc_sgft.session.operator import Nobody, Operator
from mpc_sgft.session.verdicts import Verdicts
from mpc_sgft.storage import checkpoint, run_folder
from mpc_sgft.storage.episode_file import Episode, read_episode
from mpc_sgft.storage.metrics import GrowingTable, MetricLogger, progress
from mpc_sgft.storage.rollout import Rollout, from_episode
from mpc_sgft.storage.whole_file import naming
from mpc_sgft.views.deploy_view import DeployViewer


def deploy(cfg: DictConfig) -> int:
    """Adapt a pretrained agent with real rollouts; returns the exit code."""
    agent, _ = build.load_agent(cfg)
    real, operator = cfg.backend.name == "franka", person.make_operator(cfg)
    env = robot.make_env(cfg, operator.place) if real else build.make_env(cfg, 1)
    build.check_fits(agent.model, env)
    with ending_in_order() if real else nullcontext(), operator, closing(env.backend):
        if real:
            robot.connect(env, operator)
        if real and cfg.backend.dry_run:
            return robot.dry_run(cfg, agent.model, env)
        run = Deployment(cfg, agent, env, None if real else build.make_env(cfg, cfg.eval_episodes), operator)
        try:
            with disk_errors(lambda: f"Make room. Every whole step is on disk, {run.how_to_go_on()}"):
                summary = run.loop()
        except Stopped:
            raise
        except KeyboardInterrupt as error:  # a second Ctrl-C
            raise Stopped(run.how_to_go_on()) from error
        except SystemExit:  # the program is to end, or its terminal is gone
            with suppress(OSError):
                print(f"\n{run.how_to_go_on()}", file=sys.stderr)
            raise
        except BackendError as error:  # closing the backend, on the way out, brings the arm to rest
            if operator.stopping or run.stop.asked:
                raise Stopped(run.how_to_go_on()) from error
            raise UserError(f"{error} {run.how_to_go_on()}") from error
        finally:
            run.stop.restore()
    print(json.dumps(summary))
    return 0


class Deployment:
    """State of one deployment and its folder. Without a judge, the real rollouts themselves are the measure."""

    def __init__(
        self, cfg: DictConfig, agent: Agent, env: ControlEnv, judge: ControlEnv | None, operator: Operator | None = None
    ):
        self.cfg, self.env, self.judge = cfg, env, judge
        self.operator: Operator = operator or Nobody(quiet=cfg.quiet)
        self.folder = run_folder.start(cfg)
        (self.folder / "episodes").mkdir(exist_ok=True)
        build.prepare_process(cfg)
        self.planner = build.make_planner(cfg, env.action_dim)
        self.warm_up = build.make_warm_up(cfg, env)
        self.transfer = make_transfer(cfg, agent, build.sensed(cfg), env.task.episode_steps)
        self.frozen = agent.frozen_hash()
        self.state: dict[str, Any] = {"rollouts": 0, "aborted": 0, "scores": {}, "seconds": 0.0, "successes": 0}
        self.state |= {"interventions": 0, "rerecorded": 0, "updates": 0}
        self.state["outcomes"] = []  # (success, return) of each real rollout
        self.state["reports"] = []  # of the robot, one each session, as it was last saved
        self.watch = Stopwatch("rollout", "learn", "evaluate")
        self.state["spent"] = self.watch.spent
        self.earlier: list[dict[str, Any]] = []  # reports of the sessions before this one
        if cfg.resume is not None:
            self._resume()
            if agent.frozen_hash() != self.frozen:
                raise UserError(
                    f"cannot resume {cfg.resume}: its checkpoint ({cfg.checkpoint or 'the shipped one'}) is not the "
                    "one that the run began with. Put that one back, or start a run."
                )
            self.watch.spent = self.state["spent"]
        self.logger = self.make_logger(self.state["rollouts"] if cfg.resume is not None else None)
        self.metrics: dict[str, float] = {}  # of the last rollout
        self.verdicts = Verdicts(self, ask=person.asks(cfg))
        self.viewer = (
            DeployViewer(self.folder / "run.rrd", env, megabytes=cfg.log.rerun_mb, resume=bool(cfg.resume))
            if cfg.log.rerun
            else None
        )
        self.began = time.monotonic() - self.state["seconds"]
        run_folder.keep_told(cfg, self.folder)
        self.stop = StopRequest("rollout")  # last: what is refused until then leaves Ctrl-C as it was
        self.operator.heed(lambda: self.stop.asked)

    def loop(self) -> dict[str, Any]:
        """Run what is left, and write the summary."""
        cfg, table = self.cfg, None if self.cfg.quiet else GrowingTable()
        if self.viewer:
            self.viewer.value_map("before", self.transfer.pretrained)
        hidden = cfg.quiet or self.operator.present  # the page shows the same
        done = self.state["rollouts"]
        bar = progress(cfg.rollouts, initial=done, desc=f"deploy {cfg.chosen.method}", unit="rollout", disable=hidden)
        self.show_counts()
        while self.state["rollouts"] < cfg.rollouts:
            if self.stop.asked:
                raise Stopped(self.how_to_go_on())
            number = self.state["rollouts"] + 1
            with self.watch("rollout"):
                rollout = self._rollout(number)
            if rollout is not None:
                rollout = self.verdicts.of(rollout, number)
            if self.operator.stopping:
                raise Stopped(self.how_to_go_on())  # what was recorded counts when the session goes on
            if rollout is None:
                continue
            self._before(table)
            self._count(rollout, number, table)
            self.operator.rest()
            self.verdicts.late(number)
            bar.update(self.state["rollouts"] - bar.n)
            paused = {"learning": "paused"} if self.transfer.stays else {}
            bar.set_postfix({"real_success": f"{self.state['successes']}/{self.state['rollouts']}"} | paused)
            if self.stop.asked or self.operator.stopping:
                raise Stopped(self.how_to_go_on())
        if self.state["rollouts"] not in self.state["scores"]:  # none was driven, or it was to be longer by then
            self.evaluate(table, {})
            self.save()
        bar.close()
        return self._finish()

    def _before(self, table: GrowingTable | None) -> None:
        """Measure what was pretrained, once, before anything is learned; the first rollout need not wait for it."""
        if self.judge and not self.state["scores"]:
            self.evaluate(table, {})
            self.save()

    def _count(self, rollout: Rollout, number: int, table: GrowingTable | None) -> None:
        """Measure a rollout, learn from it unless a person had the arm or what wins stays, and save."""
        if self.operator.present:
            self.verdicts.remember()
        self.operator.enter("measuring", number)
        metrics = self._measure(rollout, number)
        lesson = rollout.lesson(self.transfer.slice_len)
        if lesson is not None:
            self.operator.enter("training", number)
            with self.watch("learn"):
                warm_up = number <= self.cfg.warmup
                metrics |= self.transfer.learn(lesson, self.operator.track, success=rollout.success, warm_up=warm_up)
            self.state["updates"] += 0 if self.transfer.stays else self.transfer.method.updates
        else:
            self.transfer.interrupt()
        self.state["rollouts"] = number
        self.state["aborted"] += rollout.aborted is not None
        self.state["interventions"] += rollout.intervened
        self.state["successes"] += rollout.success
        self.state["outcomes"].append((rollout.success, metrics["real_return"]))
        if number % self.cfg.eval_every == 0 or number == self.cfg.rollouts:
            self.evaluate(table, metrics)
        self.logger.log(number, metrics)
        self.metrics = metrics
        self.save()
        self.show_counts()

    def how_to_go_on(self) -> str:
        """What is saved, and the command that continues."""
        done = self.state["rollouts"]
        return f"saved after {done} rollouts. Go on: python -m mpc_sgft.deploy --resume {self.folder}"

    def path(self, number: int) -> Path:
        """Where a rollout is recorded."""
        return self.folder / "episodes" / f"{number:04d}.mcap"

    def _rollout(self, number: int) -> Rollout | None:
        """The next real rollout, or None if the one before is to be driven again first, or the session ends.

        One that a killed process recorded is used as it is, not driven again.
        """
        cfg, path = self.cfg, self.path(number)
        if path.exists():
            episode = self._recorded(path)
            if episode.transitions:
                self.operator.enter("ending", number)  # keys are about it
                return from_episode(episode, number)
            path.rename(path.with_suffix(".empty.mcap"))  # the robot never moved
        model, planner = self._driver(number), self.warm_up if number <= cfg.warmup else self.planner
        seed = start_seed(cfg.seed, number)
        self.operator.rest()
        if self.operator.stopping or self.stop.asked:
            return None
        self.operator.enter("resetting", number - 1)
        try:
            state = begin(self.env, seed)
        except BaseException:
            self._break_off(number)
            raise
        if self.verdicts.again(number - 1):
            return None
        try:
            return drive(
                self.env,
                model,
                planner,
                path,
                number=number,
                seed=seed,
                noise=self.transfer.method.action_noise,
                candidate_steps=tuple(cfg.candidate_steps),
                operator=self.operator,
                state=state,
            )
        except BaseException:
            self._break_off(number)
            raise

    def _recorded(self, path: Path) -> Episode:
        """The rollout that an earlier process recorded, as far as it is whole.

        Raises:
            UserError: If nothing of it can be read.
        """
        try:
            return read_episode(path)
        except ValueError as error:
            raise UserError(f"{error} Move it away: its rollout is then driven again.") from error

    def _driver(self, number: int) -> WorldModel:
        """The model that drives a rollout."""
        return self.transfer.pretrained if number <= self.cfg.warmup else self.transfer.acting

    def _break_off(self, number: int) -> None:
        """Bring the machine to rest before a rollout is done, and keep what was said of the one before."""
        try:
            self.env.backend.close()
        finally:
            self.verdicts.late(number - 1)

    def show_counts(self) -> None:
        """Tell the operator how the session stands."""
        s = self.state
        text = f"{s['successes']} of {s['rollouts']}, {s['aborted']} aborted, {s['interventions']} taken over"
        paused = "; learning paused" if self.transfer.stays else ""
        self.operator.tell(successes=f"{text}, {s['rerecorded']} driven again{paused}")

    def make_logger(self, resume_step: int | None) -> MetricLogger:
        """For metrics from here on; rows after `resume_step` are dropped."""
        log = self.cfg.log
        return MetricLogger(
            self.folder, csv=log.csv, tensorboard=log.tensorboard, wandb=log.wandb, resume_step=resume_step
        )

    def _measure(self, rollout: Rollout, number: int) -> dict[str, float]:
        """Model error and improvability of a rollout under the model that drove it, and its view in rerun."""
        model, horizon = self._driver(number), self.cfg.planner.horizon
        error = open_loop_error(model, rollout.steps, horizon)
        found = audit(model, rollout.steps, self.cfg.task.discount, seed=number)
        path, names = self.folder / "audit.csv", self.env.task.observation_names
        forget_audit(path, number)  # a process that was killed while it learned had written it
        with naming(path):
            write_audit(path, number, rollout.steps, found.margin, names)
        metrics = {
            "real_success": float(rollout.success),
            "real_return": float(rollout.steps["next", "reward"].sum()),
            "aborted": float(rollout.aborted is not None),
            "audit_share": found.share,
            **{f"model_error_{h + 1}": float(error[:, h].nanmean()) for h in range(min(horizon, len(error)))},
        }
        if rollout.plan_ms is not None:
            metrics["planner_ms"] = float(rollout.plan_ms.mean())
        if self.viewer:
            self.viewer.episode(rollout, model, error, number, self.cfg.task.discount)
        return metrics

    def evaluate(self, table: GrowingTable | None, metrics: dict[str, float]) -> None:
        """Measure success now: into the state, `metrics` and the table."""
        with self.watch("evaluate"):
            result = self._score()
        self.state["scores"][self.state["rollouts"]] = result._asdict()
        metrics |= {"success": result.success, "return": result.episode_return}
        if self.viewer:
            self.viewer.success(result.success)
        if table:
            table.row(
                rollouts=self.state["rollouts"],
                success=result.success,
                **{"return": result.episode_return},
                model_error=metrics.get("model_error_1"),
                planner_ms=metrics.get("planner_ms"),
                seconds=time.monotonic() - self.began,
            )

    def _score(self) -> Score:
        """Of evaluation episodes; without a judge, of the real rollouts since the last time."""
        if self.judge is None:
            latest = self.state["outcomes"][max(self.state["scores"], default=0) :]
            return score_of(*zip(*latest, strict=True))
        seed = evaluation_seed(self.cfg)
        act, hidden = planner_policy(self.transfer.acting, self.planner, seed), self.cfg.quiet or self.operator.present
        with progress(self.judge.task.episode_steps, desc="evaluate", disable=hidden, leave=False) as bar:
            return score(collect(self.judge, shown(act, bar), seed=seed))

    def save(self) -> None:
        """Weights and exact state."""
        self.state |= {"seconds": time.monotonic() - self.began, "spent": self.watch.spent}
        if self.judge is None:
            self.state["reports"] = [*self.earlier, self.env.backend.report()]  # type: ignore[attr-defined]
        path = self.folder / "checkpoint"
        meta = checkpoint.describe(self.cfg, self.transfer.acting)
        checkpoint.save(path / "model.safetensors", self.transfer.acting, meta)
        checkpoint.save_state(path / "state.pt", {"loop": self.state, "transfer": self.transfer.state_dict()})

    def _resume(self) -> None:
        path = self.folder / "checkpoint" / "state.pt"
        if path.exists():
            stored = build.load_state(path)
            if any("episode" not in verdict for verdict in stored["transfer"]["verdicts"]):
                raise UserError(
                    f"cannot resume {self.cfg.resume}: an earlier version wrote it (it did not keep which rollouts "
                    "succeeded). Go on with that version; versions.json there names its commit."
                )
            if (done := stored["loop"]["rollouts"]) > self.cfg.rollouts:
                raise UserError(
                    f"rollouts={self.cfg.rollouts}: {self.cfg.resume} has {done} already. Give as many or more."
                )
            self.state |= stored["loop"]
            self.earlier = list(self.state["reports"])
            self.transfer.load_state_dict(stored["transfer"])

    def _finish(self) -> dict[str, Any]:
        agent = self.transfer.agent
        if agent.frozen_hash() != self.frozen:
            raise AssertionError("a frozen tensor changed during deployment; this is a defect, please report it")
        if self.viewer:
            self.viewer.value_map("after", self.transfer.acting)
            self.viewer.close()
        scores, cfg = self.state["scores"], self.cfg
        reached = [int(k) for k, s in scores.items() if s["success"] >= 0.9]
        summary = {
            "task": cfg.chosen.task,
            "gap": cfg.chosen.gap,
            "method": cfg.chosen.method,
            "seed": cfg.seed,
            "real_rollouts": self.state["rollouts"],
            "aborted_rollouts": self.state["aborted"],
            "interventions": self.state["interventions"],
            "rerecorded": self.state["rerecorded"],
            "updates": self.state["updates"],
            "zero_shot_success": scores[0]["success"] if 0 in scores else None,
            "final_success": scores[max(scores)]["success"],
            "final_interval": [scores[max(scores)]["success_low"], scores[max(scores)]["success_high"]],
            "evaluation_episodes": scores[max(scores)]["episodes"],
            "rollouts_to_90": min(reached) if reached else None,
            "curve": {str(k): s["success"] for k, s in scores.items()},
            "return_curve": {str(k): s["episode_return"] for k, s in scores.items()},
            "horizon": cfg.planner.horizon,
            "frozen_sha256": self.frozen,
            "wall_seconds": round(time.monotonic() - self.began, 1),
            "seconds": self.watch.rounded(),
            "robot": self.env.backend.report() if self.judge is None else None,
            "robot_before": self.earlier,
            "rrd": str(self.folder / "run.rrd") if self.viewer else None,
        }
        run_folder.write_summary(self.folder, summary)
        self.logger.close()
        return summary
