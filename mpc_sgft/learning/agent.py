"""World model + optimisers: update() is the TD-MPC2 objective; methods of deployment add to it elsewhere."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from mpc_sgft.learning import losses
from mpc_sgft.learning.averaged import AveragedWeights
from mpc_sgft.learning.optimizers import PRETRAINED, Optimizers
from mpc_sgft.learning.precision import dtype_of_products, in_own_precision
from mpc_sgft.learning.slices import FiniteWatch, Slices, arranged, floats
from mpc_sgft.learning.world_model import WorldModel
from planners.cuda_graph import CudaGraphs, addresses

FOLLOWING = ("normalizer", "target_q")  # not by gradient


class Agent:
    """Trains a world model; the numbers are explained in configs/train/default.yaml.

    Args:
        model: Trained in place.
        seed: Of the noise in the updates.
        device: Where model and batches live.
        discount: Of the task, per control step.
        rho: Weight of imagined step t is rho^t.
        others: configs/train/default.yaml, group `agent`.

    Attributes:
        pretraining: The normaliser and the averaged weights follow each update; False once a method took over.
        imagined_steps: Of the policy's objective in pretraining; 0: it climbs the critics.
        trainable: Parts of the model that updates may change; everything else is frozen.
    """

    def __init__(
        self,
        model: WorldModel,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        discount: float,
        rho: float,
        lr: float,
        encoder_lr_share: float,
        grad_clip: float,
        consistency_weight: float,
        reward_weight: float,
        q_weight: float,
        value_weight: float,
        decoder_weight: float,
        target_rate: float,
        average_decay: float,
        scale_rate: float,
        entropy_coef: float,
        entropy_lr: float,
        policy_delay: int = 1,
        td_lambda: float = 0.0,
        precision: str = "float32",
        cuda_graph: bool = True,
    ) -> None:
        if not 0 <= discount <= 1 or not 0 < rho <= 1:
            raise ValueError(f"discount must lie in [0, 1] and rho in (0, 1], got discount={discount}, rho={rho}.")
        self.device = torch.device(device)
        self.model = model.to(self.device).train()
        self.discount, self.rho, self.grad_clip, self.target_rate = discount, rho, grad_clip, target_rate
        if policy_delay < 1:
            raise ValueError(f"policy_delay must be 1 or more updates, got {policy_delay}.")
        if not 0 <= td_lambda <= 1:
            raise ValueError(f"td_lambda must lie in [0, 1], got {td_lambda}.")
        self.lr, self.encoder_lr_share, self.entropy_lr = lr, encoder_lr_share, entropy_lr
        self.policy_delay, self.td_lambda, self.updates = policy_delay, td_lambda, 0
        self._watch = FiniteWatch()
        self.weights = {
            "consistency_loss": consistency_weight,
            "reward_loss": reward_weight,
            "q_loss": q_weight,
            "value_loss": value_weight,
            "decoder_loss": decoder_weight,
        }
        self.products = dtype_of_products(precision, int(model.sizes["mlp_dim"]), self.device)
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.scale = losses.RunningScale(scale_rate, self.device)  # of values
        self.objective_scale = losses.RunningScale(scale_rate, self.device)  # of the SGFT objective
        self.log_entropy_coef = torch.tensor(entropy_coef, device=self.device).log().requires_grad_()
        self._averaged = AveragedWeights(self.model, average_decay)
        self.pretraining, self.imagined_steps = True, 0
        self._graphs = CudaGraphs() if cuda_graph and self.device.type == "cuda" else None
        self.trainable: tuple[str, ...] = (*PRETRAINED, *FOLLOWING)
        self._make_optimizers(lr, lr)

    @property
    def averaged(self) -> WorldModel:
        """The model with its weights averaged over the last updates of pretraining: what is evaluated and saved."""
        return self._averaged.model

    def scale_learning_rates(self, share: float) -> None:
        """Set the learning rates of model and policy prior to a share of the configured ones."""
        self.optimizers.scale(share)

    def hold_value(self, held: bool) -> None:
        """Whether encoder and V stay as they are while everything else learns in simulation."""
        for part in ("encoder", "value_head"):
            getattr(self.model, part).requires_grad_(not held)

    # -- learning in simulation ----------------------------------------------------------------------------------------

    @in_own_precision
    def update(self, batch: TensorDictBase, *, read: bool = True) -> dict[str, float]:
        """One step of the TD-MPC2 objective with a value head, on slices [B, T]; returns metrics.

        Args:
            batch: As from the buffer.
            read: False: the host does not wait for the device. There are no metrics then, and what is not finite shows
                in the next update that is read.

        Raises:
            FloatingPointError: If an entry of the batch or a loss is not finite; that loss has changed no parameter.
        """
        data, policy_too = arranged(batch, self.device), self.updates % self.policy_delay == 0
        if read or self._graphs is None or not self.pretraining:
            metrics = self._step(data, policy_too, read)
        else:
            self._replayed(self._graphs, data, policy_too)
            metrics = {}
        self.updates += 1
        return floats(metrics) if read else {}

    def _replayed(self, graphs: CudaGraphs, data: Slices, policy_too: bool) -> None:
        """An update that is not read, as one CUDA graph."""

        def step(generator: torch.Generator, *tensors: Tensor) -> dict[str, Tensor]:
            kept = self.generator, self._watch
            self.generator, self._watch = generator, FiniteWatch()
            try:
                self._step(Slices(*tensors), policy_too, read=False)
                return self._watch.taken()
            finally:
                self.generator, self._watch = kept

        trains = tuple(p.requires_grad for p in self.optimizers.trained)
        where = self.model.training, addresses(self.model)
        key = (policy_too, self.imagined_steps, trains, data.action.shape, *where)
        self._watch.also(graphs(key, step, data, self.generator))

    def _step(self, data: Slices, policy_too: bool, read: bool) -> dict[str, Tensor]:
        model = self.model
        self._note(data.numbers(), read)
        if self.pretraining:
            model.normalizer.update(data.observation[0])
        first_z = model.encode(data.observation[0])  # [B, D], trains the encoder
        with torch.no_grad():
            encoded = torch.cat([first_z.unsqueeze(0), model.encode(data.observation[1:])])  # [T + 1, B, D]
        noise = self.noise(*encoded.shape[:-1])
        heads = self.two_heads()
        target = losses.targets(model, encoded, data, noise, heads, self.discount, self.td_lambda)

        zs = losses.imagine(model.dynamics, first_z, data.action)  # [T + 1, B, D]
        q_logits = model.q_logits(zs[:-1], data.action)  # [E, T, B, bins]
        as_read = model.dynamics.as_simulated(zs).detach()  # by V at a plan's end
        per_step = {
            "consistency_loss": losses.consistency_loss(zs[1:], encoded[1:]),
            "reward_loss": losses.two_hot_loss(model.reward_logits(zs[:-1], data.action, zs[1:]), target.reward),
            "q_loss": losses.two_hot_loss(q_logits, target.q.expand_as(q_logits)).mean(0),
            "value_loss": losses.two_hot_loss(model.value_head(as_read), target.value),
        }
        if policy_too:
            per_step["decoder_loss"] = self._decoder_loss(encoded, data.observation)
        metrics = {name: losses.over_time(loss, self.rho) for name, loss in per_step.items()}
        total = torch.stack([self.weights[name] * loss for name, loss in metrics.items()]).sum()
        self._note(metrics, read)
        metrics["loss"] = total
        metrics["grad_norm"] = self.step_model(total)

        if policy_too:
            imagine = self.pretraining and self.imagined_steps > 0
            metrics |= (
                self._update_policy_imagined(encoded[0], read) if imagine else self._update_policy(zs.detach(), read)
            )
        model.update_targets(self.target_rate)
        if self.pretraining:
            self._averaged.follow(model)
        metrics["target_value"] = target.mean
        return metrics

    def _note(self, values: Mapping[str, Tensor], check: bool) -> None:
        self._watch.note(values)
        if check:
            self._watch.check()

    def _update_policy(self, zs: Tensor, read: bool) -> dict[str, Tensor]:
        noise, heads = self.noise(*zs.shape[:-1]), self.two_heads()
        with self._constant_but_policy():
            action, log_prob = self.model.policy(zs, noise)
            q = self.model.q(zs, action, heads=heads)  # [2, T + 1, B]
        scale = self.scale.update(q.detach()[:, 0])
        coef = self.log_entropy_coef.detach().exp()
        loss = losses.over_time(losses.policy_loss(q, log_prob, coef, scale), self.rho)
        metrics = self.step_policy(loss, log_prob, read) | {"entropy_coef": coef, "scale": scale}
        self._tune_entropy(log_prob)
        return metrics

    def _update_policy_imagined(self, starts: Tensor, read: bool) -> dict[str, Tensor]:
        coef = self.log_entropy_coef.detach().exp()
        metrics, log_prob = self._climb(starts, self.imagined_steps, coef, read)
        with torch.no_grad():
            self.scale.update(self.model.terminal_value(starts))  # what planners will measure values in
        self._tune_entropy(log_prob)
        return metrics | {"entropy_coef": coef}

    def _climb(
        self, starts: Tensor, horizon: int, coef: Tensor | float, read: bool
    ) -> tuple[dict[str, Tensor], Tensor]:
        noise = self.noise(horizon, len(starts))
        with self._constant_but_policy():
            objective, log_prob = losses.imagined_objective(self.model, starts, noise, self.discount)
        scale = self.objective_scale.update(objective.detach())
        metrics = self.step_policy(coef * log_prob.mean() - objective.mean() / scale, log_prob, read)
        return metrics | {"objective": objective.mean(), "scale": scale}, log_prob

    def step_model(self, loss: Tensor, parameters: Sequence[Tensor] | None = None) -> Tensor:
        """A step of the model down a loss, of these parameters or of all that train; returns the slope's length."""
        self.optimizers.model.zero_grad()
        loss.backward(inputs=parameters)
        length = torch.nn.utils.clip_grad_norm_(parameters or self.optimizers.trained, self.grad_clip, foreach=True)
        self.optimizers.model.step()
        return length

    def step_policy(self, loss: Tensor, log_prob: Tensor, read: bool = True) -> dict[str, Tensor]:
        """A step of the policy prior down a loss of its own actions, whose log-density is given."""
        self._note({"policy_loss": loss}, read)
        parameters = list(self.model.policy_head.parameters())
        self.optimizers.policy.zero_grad()
        loss.backward(inputs=parameters)  # nothing else collects a gradient here
        torch.nn.utils.clip_grad_norm_(parameters, self.grad_clip, foreach=True)
        self.optimizers.policy.step()
        return {"policy_loss": loss, "entropy": -log_prob.mean()}

    def _tune_entropy(self, log_prob: Tensor) -> None:
        if self.entropy_lr:
            self.optimizers.entropy.zero_grad()
            losses.entropy_coef_loss(self.log_entropy_coef, log_prob, -float(self.model.action_dim)).backward()
            self.optimizers.entropy.step()

    # -- what methods of deployment use --------------------------------------------------------------------------------

    def train_only(
        self,
        parts: tuple[str, ...],
        *,
        lr: float,
        policy_lr: float,
        command_lr: float | None = None,
        observation_lr: float | None = None,
        following: tuple[str, ...] = (),
    ) -> None:
        """End pretraining: freeze everything but some parts, and start fresh optimisers and TD-MPC2's own targets.

        Args:
            parts: Of the model, dotted names such as `dynamics.residual`; they train by gradient.
            lr: Of Adam for these; the encoder takes its share of it.
            policy_lr: Of Adam for the policy prior.
            command_lr: Of Adam for the command map of the dynamics; None: lr.
            observation_lr: Of Adam for the observation map; None: lr.
            following: Parts, or single buffers, that change without a gradient.
        """
        self.pretraining, self.trainable = False, (*parts, *following)
        self.policy_delay, self.td_lambda = 1, 0.0
        self.model.requires_grad_(False)
        for part in parts:
            self.model.get_submodule(part).requires_grad_(True)
        if parts:
            self._make_optimizers(lr, policy_lr, command_lr, observation_lr)

    def dynamics_parameters(self) -> list[Tensor]:
        """What trains of the dynamics, the command map left out."""
        dynamics = self.model.dynamics
        modules = (dynamics.base, dynamics.residual)
        return [p for module in modules if module for p in module.parameters() if p.requires_grad]

    @in_own_precision
    def climb(self, starts: Tensor, *, horizon: int, entropy_coef: float) -> dict[str, Tensor]:
        """A step of the policy prior up the SGFT objective of `horizon` imagined steps from latents [B, D]."""
        return self._climb(starts, horizon, entropy_coef, read=True)[0]

    # -- state ---------------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Copy of what trains: parameters and optimisers. Give it to `restore` to undo updates."""
        state = {name: x.detach().clone() for name, x in self.model.state_dict().items() if self._trains(name)}
        scales = {"scale": self.scale.value.clone(), "objective_scale": self.objective_scale.value.clone()}
        rest = {"log_entropy_coef": self.log_entropy_coef.detach().clone(), **scales}
        return {"model": state, "optimizers": self.optimizers.state_dict(), **rest}

    @torch.no_grad()
    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Undo every update since `snapshot` was taken; the noise generator goes on."""
        self.model.load_state_dict(snapshot["model"], strict=False)
        self.optimizers.load_state_dict(snapshot["optimizers"])
        if self._graphs is not None:
            self._graphs.clear()  # what they read has moved
        self.log_entropy_coef.copy_(snapshot["log_entropy_coef"])
        self.scale.value.copy_(snapshot["scale"])
        self.objective_scale.value.copy_(snapshot.get("objective_scale", snapshot["scale"]))  # once there was one scale

    def frozen_hash(self) -> str:
        """SHA-256 of the names and bytes of every tensor of the model that does not train, in hexadecimal."""
        digest = hashlib.sha256()
        for name, x in sorted(self.model.state_dict().items()):
            if not self._trains(name):
                digest.update(name.encode())
                digest.update(x.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on with the same numbers; the torch global generator (dropout) is included."""
        return {
            "trainable": self.trainable,
            "model": {name: x.detach().clone() for name, x in self.model.state_dict().items()},
            "averaged": self._averaged.state_dict() if self.pretraining else None,
            "snapshot": self.snapshot(),
            "updates": self.updates,
            "generator": self.generator.get_state(),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state(self.device) if self.device.type == "cuda" else None,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict` of an agent of the same sizes and numbers, in which the same parts train.

        Raises:
            ValueError: If others train there.
        """
        if tuple(state["trainable"]) != self.trainable:
            raise ValueError(f"the saved agent trains {state['trainable']}, this one {self.trainable}")
        self.model.load_state_dict(state["model"])
        if state["averaged"] is not None:
            self._averaged.load_state_dict(state["averaged"])
        self.restore(state["snapshot"])
        self.updates = state["updates"]
        self.generator.set_state(state["generator"].cpu())
        torch.set_rng_state(state["torch_rng"].cpu())
        if state["cuda_rng"] is not None and self.device.type == "cuda":
            torch.cuda.set_rng_state(state["cuda_rng"].cpu(), self.device)

    # -- helpers -------------------------------------------------------------------------------------------------------

    def _make_optimizers(
        self, lr: float, policy_lr: float, command_lr: float | None = None, observation_lr: float | None = None
    ) -> None:
        if self._graphs is not None:
            self._graphs.clear()
        self.optimizers = Optimizers(
            self.model,
            self.log_entropy_coef,
            lr=lr,
            encoder_lr_share=self.encoder_lr_share,
            policy_lr=policy_lr,
            entropy_lr=self.entropy_lr,
            command_lr=command_lr,
            observation_lr=observation_lr,
            recorded=self._graphs is not None and self.pretraining,
        )

    @contextmanager
    def _constant_but_policy(self) -> Iterator[None]:
        """What is computed within has slopes for the policy prior alone: those of all else are never computed."""
        parameters = self.model.named_parameters()
        others = [p for name, p in parameters if p.requires_grad and not name.startswith("policy_head.")]
        for parameter in others:
            parameter.requires_grad_(False)
        try:
            yield
        finally:
            for parameter in others:
                parameter.requires_grad_(True)

    def _trains(self, name: str) -> bool:
        return any(name == part or name.startswith(part + ".") for part in self.trainable)

    def _decoder_loss(self, z: Tensor, observation: Tensor) -> Tensor:
        wanted = self.model.normalizer(observation)[..., : self.model.sizes["decode_dim"]]
        return (self.model.decoder(z.detach()) - wanted).square().mean(-1)

    def noise(self, *shape: int) -> Tensor:
        """Standard normal numbers for actions, [*shape, A]."""
        return torch.randn(*shape, self.model.action_dim, generator=self.generator, device=self.device)

    def two_heads(self) -> list[int] | Tensor | None:
        """Which two critics' minimum counts now; None if there are no more."""
        if self.model.num_q == 2:
            return None
        if self.device.type == "cuda":  # the host is not asked
            return torch.rand(self.model.num_q, generator=self.generator, device=self.device).argsort()[:2]
        return torch.randperm(self.model.num_q, generator=self.generator)[:2].tolist()
