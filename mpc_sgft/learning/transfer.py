"""Learning from few real rollouts without losing what the simulator taught.

The dynamics and the policy that act are not simply the ones that train. A model fine-tuned on two hundred transitions
of five rollouts has forgotten what it knew elsewhere, and where zero-shot already worked that does harm. So each new
rollout is first a test: it has not been trained on, and the pretrained and the fine-tuned dynamics both predict it. The
fine-tuned parts act once they have predicted such rollouts clearly better, until then the pretrained do, and they go on
while they are better at all: rollouts that succeed are easy to predict, so the difference is small there. Better at
what a policy does every time is not better where it does not go, though, and a planner looks there: so the dynamics
beneath the maps may stay the simulator's where these predict reality as well as they do simulation. What is tested and
acts is the average of the weights over the last updates, since the last ones alone are one draw of many; of the policy
prior, a share of the way from the pretrained one (Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR
2022).
"""

import copy
import statistics
from collections.abc import Callable, Iterable
from functools import partial
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.averaged import AveragedWeights
from mpc_sgft.learning.buffer import make_buffer
from mpc_sgft.learning.choice import Choice, Verdict, begins
from mpc_sgft.learning.method import AbstractMethod, Gate
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.learning.world_model import WorldModel

WITHOUT_GATE = Gate(margin=1.0, memory=5)  # without one the command map acts that predicts better
SIMULATED = 32  # episodes that tell how well the pretrained dynamics predict what they were made for
SHARED = "observation", "action", "episode", "step", *(("next", k) for k in ("observation", "reward", "terminated"))


class Transfer:
    """The agent that trains, the model that acts, and the gate between them.

    Args:
        agent: Pretrained agent; the method takes it over.
        method: What trains, and how.
        capacity: Real transitions to hold.
        batch_size, seed: Of the replay slices.
        sensed: As in `AbstractMethod.take_over`.
        simulated: Gives as many simulated episodes [N, T] as it is asked for; asked by methods that learn from some,
            and by a gate that compares with them.

    Raises:
        ValueError: If simulated episodes are wanted and there is nothing that makes them.
    """

    def __init__(
        self,
        agent: Agent,
        method: AbstractMethod,
        sensed: Sensed,
        *,
        capacity: int,
        batch_size: int,
        seed: int,
        simulated: Callable[[int], TensorDict] | None = None,
    ):
        self.agent, self.method, self.slice_len = agent, method, method.slice_len
        agent.model.sizes["terminal"] = method.terminal  # whatever the checkpoint was last used with
        self.simulated = None
        sizes = {"slice_len": method.slice_len, "batch_size": batch_size, "seed": seed, "device": agent.device}
        compares = method.gate is not None and method.gate.excess > 0
        if simulated is None and (method.simulated_episodes or compares):
            raise ValueError(f"{type(method).__name__} needs simulated episodes here: give what makes them.")
        if simulated and method.simulated_episodes:
            steps = simulated(method.simulated_episodes)  # before the method changes anything
            sizes["batch_size"] = batch_size // 2
            self.simulated = make_buffer(steps.numel(), **sizes)
            self.simulated.extend(steps)
        self._simulate = simulated
        self.simulated_error: float | None = None  # of the pretrained dynamics over simulated episodes, once asked for
        method.take_over(agent, sensed)
        self._new_buffer = partial(make_buffer, capacity, **sizes)
        self.buffer = self._new_buffer()
        self.pretrained = copy.deepcopy(agent.model)
        self.averaged = AveragedWeights(agent.model, method.average_decay)
        self.acting: WorldModel = copy.deepcopy(agent.model)
        self.verdicts: list[Verdict] = []
        self.starts: list[Tensor] = []  # first observation of each rollout
        self.streak_from = 0  # the verdict with which a streak of wins may begin

    def judge(self, steps: TensorDict, *, success: bool = False, warm_up: bool = False) -> Verdict:
        """Test the dynamics on a rollout [T] before it is learned from, and decide who acts next; as in `learn`."""

        def error(model: WorldModel) -> float:
            return float(open_loop_error(model, steps, self.slice_len).nanmean())

        gate, last = self.method.gate, self.verdicts[-1] if self.verdicts else None
        limit = gate.excess * self._error_in_simulation() if gate and gate.excess else 0.0
        stays = not warm_up and self._wins(success)
        mapped, band, suspicion = self._choose_maps(error, asked=limit > 0, success=success, stays=stays)
        verdict = Verdict(
            error(self.pretrained),
            error(self.averaged.model),
            gate is None,
            mapped=mapped,
            band=band,
            suspicion=suspicion,
            success=success,
            episode=int(steps["episode"][0]),
        )
        if stays and last:
            verdict = verdict._replace(accepted=last.accepted, beneath=last.beneath)
        elif gate and last:
            seen = [*self.verdicts[1:], verdict][-gate.memory :]  # at the first rollout all were still the same
            accepted = begins([(v.fine_tuned, v.pretrained) for v in seen], last.accepted, gate.margin)
            errors = [e for v in seen if (e := v.with_maps_of(verdict)) is not None]
            beneath = not limit or statistics.geometric_mean(errors) > limit
            verdict = verdict._replace(accepted=accepted, beneath=beneath)
        self.verdicts.append(verdict)
        if warm_up:
            self.interrupt()
        return verdict

    def _choose_maps(
        self, error: Callable[[WorldModel], float], *, asked: bool, success: bool, stays: bool
    ) -> tuple[float | None, Choice | None, Choice | None]:
        """What a verdict says of the maps; all models but the one that acts are told which of them act from now on.

        Args:
            error: Of a model on this rollout.
            asked: It is wanted even where there is nothing to choose.
            success: The rollout reached its goal: it tells nothing of a suspicion. A sensor that lies by so much that
                something is to be gained keeps rollouts from it, while other physics may look like such a sensor.
            stays: What acts stays, whatever is found.
        """
        has_band, margin = self.agent.model.dynamics.banded is not None, self.method.suspicion_margin
        if not (asked or has_band or margin):
            return None, None, None
        simulator = copy.deepcopy(self.averaged.model)
        self._simulate_beneath(simulator)
        gate, before = self.method.gate or WITHOUT_GATE, self.verdicts[1:]

        def choose(
            set_acting: Callable[[WorldModel, bool], object], name: str, margin: float, *, by_failures: bool = False
        ) -> Choice:
            told = [getattr(v, name) for v in before if not (by_failures and v.success)]
            last = getattr(before[-1], name) if before else None
            errors, acts = [], bool(last and last.rival_acts)
            for rival in (False, True):
                set_acting(simulator, rival)
                errors.append(error(simulator))
            choice = Choice(errors[0], errors[1], acts)
            if self.verdicts and not stays and not (by_failures and success):
                pairs = [(c.rival, c.plain) for c in [*told, choice] if c][-gate.memory :]
                choice = choice._replace(rival_acts=begins(pairs, acts, margin))
            for model in (simulator, self.agent.model, self.averaged.model):
                set_acting(model, choice.rival_acts)
            return choice

        if margin:
            simulator.suspect(False)  # until it is chosen
        band = choose(WorldModel.use_band, "band", gate.margin) if has_band else None
        mapped = band.plain if band else error(simulator)
        suspicion = choose(WorldModel.suspect, "suspicion", margin, by_failures=True) if margin else None
        return mapped, band, suspicion

    def _error_in_simulation(self) -> float:
        """Of the pretrained dynamics; asked for at the first rollout, when nothing has trained yet."""
        if self.simulated_error is None:
            assert self._simulate is not None  # a gate that compares is refused without
            self.simulated_error = mean_error(self.pretrained, self._simulate(SIMULATED), self.slice_len)
        return self.simulated_error

    def learn(
        self,
        steps: TensorDict,
        track: Callable[[range], Iterable[int]] = iter,
        *,
        success: bool = False,
        warm_up: bool = False,
    ) -> dict[str, float]:
        """Judge a rollout [T], learn from all there are, and hand over the parts that may act; returns metrics.

        Where the method stays with what wins, and the last rollouts all did, the rollout is kept and no more happens.

        Args:
            steps: The rollout, of one `episode`.
            track: Shows how far the gradient steps are, as tqdm does.
            success: It reached its goal.
            warm_up: The simulation policy drove it: that says nothing of what acts.
        """
        verdict = self.judge(steps, success=success, warm_up=warm_up)
        self.buffer.extend(steps)
        self.starts.append(steps["observation"][0].to(self.agent.device))
        if self.stays:
            return verdict.metrics()
        starts, metrics = torch.stack(self.starts), dict[str, float]()
        for _ in track(range(self.method.updates)):
            metrics = self.method.update(self.agent, self.batch(), starts=starts)
            self.averaged.follow(self.agent.model)
        self._hand_over(verdict)
        return metrics | verdict.metrics()

    @property
    def stays(self) -> bool:
        """Whether the last rollouts all reached their goal, so that nothing is learned until one does not."""
        return self._wins()

    def _wins(self, *more: bool) -> bool:
        """Whether the last rollouts all reached their goal, with these after those that were judged."""
        last, wins = self.method.win_stay, [*(v.success for v in self.verdicts[self.streak_from :]), *more]
        return last > 0 and wins[-last:] == [True] * last

    def interrupt(self) -> None:
        """Count wins anew: what was driven last was not learned from, or by others than what acts."""
        self.streak_from = len(self.verdicts)

    def correct(self, episode: int, success: bool) -> None:
        """Let a rollout, if it was learned from, have reached its goal or not; what acts now stays."""
        self.verdicts = [v._replace(success=success) if v.episode == episode else v for v in self.verdicts]

    def batch(self) -> TensorDictBase:
        """What an update learns from, [B, T]: real slices, and as many simulated ones if the method wants them."""
        if self.simulated is None:
            return self.buffer.sample()
        parts = [buffer.sample().select(*SHARED) for buffer in (self.buffer, self.simulated)]
        return cast(TensorDictBase, TensorDict.cat(parts))

    @torch.no_grad()
    def _hand_over(self, verdict: Verdict) -> None:
        self.acting.load_state_dict((self.averaged.model if verdict.accepted else self.pretrained).state_dict())
        if not verdict.beneath:
            self._simulate_beneath(self.acting)
        priors = self.acting.policy_head.parameters(), self.pretrained.policy_head.parameters()
        torch._foreach_lerp_([*priors[0]], [*priors[1]], 1 - self.method.policy_share)  # type: ignore

    def _simulate_beneath(self, model: WorldModel) -> None:
        """Put the pretrained dynamics beneath a model's maps."""
        for name in ("base", "residual"):
            part = getattr(model.dynamics, name)
            if part is not None:
                part.load_state_dict(getattr(self.pretrained.dynamics, name).state_dict())

    def state_dict(self) -> dict:
        return {
            "agent": self.agent.state_dict(),
            "method": self.method.state_dict(),
            "buffer": self.buffer.state_dict(),
            "simulated": None if self.simulated is None else self.simulated.state_dict(),
            "averaged": self.averaged.state_dict(),
            "acting": {k: x.clone() for k, x in self.acting.state_dict().items()},
            "starts": [x.clone() for x in self.starts],
            "verdicts": [v.state() for v in self.verdicts],
            "simulated_error": self.simulated_error,
            "streak_from": self.streak_from,
        }

    def load_state_dict(self, state: dict) -> None:
        self.agent.load_state_dict(state["agent"])
        self.method.load_state_dict(state["method"])
        self.buffer = self._new_buffer()  # what is loaded may hold less than what is there
        self.buffer.load_state_dict(state["buffer"])
        if self.simulated is not None:
            self.simulated.load_state_dict(state["simulated"])
        self.averaged.load_state_dict(state["averaged"])
        self.acting.load_state_dict(state["acting"])
        self.starts = [x.to(self.agent.device) for x in state["starts"]]
        self.verdicts = [Verdict.from_state(v) for v in state["verdicts"]]
        self.simulated_error, self.streak_from = state["simulated_error"], state["streak_from"]


def mean_error(model: WorldModel, episodes: TensorDict, horizon: int) -> float:
    """Geometric mean of the mean `open_loop_error` of the episodes in rows [N, T], which may have ended early."""
    errors = []
    for row in episodes:
        valid = row[~row["next", "invalid"][:, 0]]
        for number in valid["episode"].unique().tolist():
            steps = valid[valid["episode"] == number]
            if len(steps) >= horizon:
                errors.append(float(open_loop_error(model, steps, horizon).nanmean()))
    return statistics.geometric_mean(errors)


@torch.inference_mode()
def open_loop_error(model: WorldModel, steps: TensorDict, horizon: int) -> Tensor:
    """Squared latent error of imagining the taken actions, [T, H]; nan where the episode had ended, or failed, before.

    Args:
        model: Whose dynamics.
        steps: One episode, [T]; the last may be `invalid`: nothing was seen after it.
        horizon: H, steps imagined from each step.
    """
    device, count = next(model.parameters()).device, int((~steps["next", "invalid"]).sum())
    action = steps["action"][:count].to(device)
    target = model.encode(steps["next", "observation"][:count].to(device))
    z = model.encode(steps["observation"][:count].to(device))
    error = torch.full((len(steps), horizon), torch.nan, device=device)
    for h in range(min(horizon, count)):
        z = model.next(z[: count - h], action[h:])
        error[: count - h, h] = (z - target[h:]).square().mean(-1)
    return error.cpu()
