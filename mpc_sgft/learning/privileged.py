"""A policy that randomisation alone must make robust, taught by critics that know what the simulator drew.

Memoryless it is the asymmetric actor-critic (Pinto et al., RSS 2018, arXiv:1710.06542), with a memory the recurrent
policy of dynamics randomisation (Peng et al., ICRA 2018, arXiv:1710.06537), whose critics know the dynamics too.
"""

import copy
from collections.abc import Mapping, Sized
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from mpc_sgft.learning import losses
from mpc_sgft.learning.averaged import AveragedWeights
from mpc_sgft.learning.gaussian import gaussian_tanh
from mpc_sgft.learning.layers import Ensemble, mlp
from mpc_sgft.learning.slices import check_finite, floats
from mpc_sgft.learning.world_model import WorldModel


class PrivilegedActorCritic:
    """Trains a policy from nothing on the latents of a pretrained model, of which everything else stays.

        y = r + gamma (1 - terminated) (min_e Qbar_e(z', x', a') - alpha log pi(a'|h')),   a' ~ pi(h')
        the policy climbs mean_e Q_e(z, x, a) / scale - alpha log pi(a|h)

    x is what the simulator alone knows: the observation without noise, and where in its range each draw lies. h is the
    latent z, or with a memory all latents of the episode. alpha follows the entropy, as in SAC.

    What differs from the publications: the policy sees latents of the pretrained world model, critics are two-hot, and
    both learn by SAC, where there it is DDPG and its recurrent form with hindsight goals.

    Args:
        model: Pretrained; its `policy_head` is begun anew, or it gets a `recurrent_policy`.
        draws: What randomisation draws.
        memory_dim: Entries of the policy's memory; 0: none.
        lr, policy_lr: Of Adam for critics and policy.
        policy_delay: Updates of the critics for each of the policy.
        grad_clip, target_rate, average_decay, entropy_coef, entropy_lr: As in configs/train/default.yaml.
        seed, device, discount: As in `Agent`.

    Raises:
        ValueError: If policy_delay is not positive, memory_dim is negative, or the model remembers already.
    """

    def __init__(
        self,
        model: WorldModel,
        *,
        draws: Sized,
        memory_dim: int,
        lr: float,
        policy_lr: float,
        policy_delay: int,
        grad_clip: float,
        target_rate: float,
        average_decay: float,
        entropy_coef: float,
        entropy_lr: float,
        seed: int = 0,
        device: torch.device | str = "cpu",
        discount: float,
    ) -> None:
        if policy_delay < 1 or memory_dim < 0:
            raise ValueError(f"policy_delay={policy_delay} must be 1 or more, and memory_dim={memory_dim} 0 or more.")
        self.device = torch.device(device)
        self.discount, self.policy_delay = discount, policy_delay
        self.grad_clip, self.target_rate, self.updates = grad_clip, target_rate, 0
        sizes = model.sizes
        hidden, raw = int(sizes["mlp_dim"]), int(sizes["decode_dim"])
        self.policy = model.begin_policy(memory_dim)
        self.model = model.to(self.device).train().requires_grad_(False)
        self.policy.requires_grad_(True)
        width = [model.latent_dim + raw + len(draws) + model.action_dim, hidden, hidden, int(sizes["num_bins"])]
        self.critics = Ensemble(mlp(width, zero_out=True) for _ in range(2)).to(self.device)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_entropy_coef = torch.tensor(entropy_coef, device=self.device).log().requires_grad_()
        self.optimizers = {
            "critics": torch.optim.Adam(self.critics.parameters(), lr=lr, fused=True),
            "policy": torch.optim.Adam(self.policy.parameters(), lr=policy_lr, eps=1e-5, fused=True),
            "entropy": torch.optim.Adam([self.log_entropy_coef], lr=entropy_lr, fused=True),
        }
        self._full = {name: optimizer.param_groups[0]["lr"] for name, optimizer in self.optimizers.items()}
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.scale = losses.RunningScale(0.0, self.device)  # stays what the pretrained values ranged over
        self.scale.value.fill_(model.value_range)
        self._averaged = AveragedWeights(self.model, average_decay)

    @property
    def averaged(self) -> WorldModel:
        """The model with the policy's weights averaged over the last updates: what is evaluated and saved."""
        return self._averaged.model

    def scale_learning_rates(self, share: float) -> None:
        """Set the learning rates of critics and policy to a share of the configured ones."""
        for name in ("critics", "policy"):
            self.optimizers[name].param_groups[0]["lr"] = share * self._full[name]

    def update(self, batch: TensorDictBase, *, read: bool = True) -> dict[str, float]:
        """One step of the critics, every `policy_delay`-th time of the policy, and of the target critics.

        Args:
            batch: Rows [B, T] as from `RowBuffer`, with what the simulator knows under `privileged`.
            read: False: no metrics.

        Raises:
            FloatingPointError: If an entry of the batch or a loss is not finite; that part has changed nothing then.
        """
        batch, model = batch.to(self.device), self.model
        after = cast(TensorDictBase, batch["next"])
        seen = torch.cat([batch["observation"], after["observation"][:, -1:]], 1)  # [B, T + 1, O]
        reward, ended = after["reward"][..., 0], after["terminated"][..., 0]  # [B, T]
        counts = (~after["invalid"][..., 0]).float()
        known, then = self._known(batch["privileged"]), self._known(after["privileged"])  # [B, T, X]
        check_finite({"observation": seen, "reward": reward, "privileged": known, "next privileged": then})
        with torch.no_grad():
            z = model.encode(seen)  # [B, T + 1, D]
        begins = torch.cat([batch["step"] == 0, torch.zeros_like(ended[:, :1])], 1)

        coef = self.log_entropy_coef.detach().exp()
        with torch.no_grad():
            action, log_prob = self._act(z, begins)
            worth = self._worth(self.targets, z[:, 1:], then, action[:, 1:]).amin(0) - coef * log_prob[:, 1:]
            target = reward + self.discount * torch.where(ended, 0.0, worth)
        logits = self.critics(torch.cat([z[:, :-1], known, batch["action"]], -1))  # [2, B, T, bins]
        loss = losses.two_hot_loss(logits, model.two_hot.encode(target).expand_as(logits))
        metrics = {"q_loss": _mean(loss, counts)}
        self._descend("critics", metrics["q_loss"])
        if self.updates % self.policy_delay == 0:
            action, log_prob = (x[:, :-1] for x in self._act(z, begins))
            worth = self._worth(self.critics, z[:, :-1], known, action)
            loss = _mean(losses.policy_loss(worth, log_prob, coef, self.scale.value), counts)
            self._descend("policy", loss)
            wanted = -float(model.action_dim)
            self._descend("entropy", losses.entropy_coef_loss(self.log_entropy_coef, log_prob, wanted))
            metrics |= {"policy_loss": loss, "entropy": -log_prob.mean(), "entropy_coef": coef}
        for there, here in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            there.data.lerp_(here.data, self.target_rate)
        self._averaged.follow(model)
        self.updates += 1
        return floats(metrics | {"loss": metrics["q_loss"], "target_value": target.mean()}) if read else {}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on with the same numbers."""
        return {
            "model": copy.deepcopy(self.model.state_dict()),
            "averaged": copy.deepcopy(self._averaged.state_dict()),
            "critics": copy.deepcopy(self.critics.state_dict()),
            "targets": copy.deepcopy(self.targets.state_dict()),
            "log_entropy_coef": self.log_entropy_coef.detach().clone(),
            "optimizers": {name: copy.deepcopy(o.state_dict()) for name, o in self.optimizers.items()},
            "updates": self.updates,
            "generator": self.generator.get_state(),
        }

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict` of one of the same sizes and numbers."""
        self.model.load_state_dict(state["model"])
        self._averaged.load_state_dict(state["averaged"])
        self.critics.load_state_dict(state["critics"])
        self.targets.load_state_dict(state["targets"])
        self.log_entropy_coef.copy_(state["log_entropy_coef"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(copy.deepcopy(state["optimizers"][name]))
        self.updates = state["updates"]
        self.generator.set_state(state["generator"].cpu())

    def _act(self, z: Tensor, begins: Tensor) -> tuple[Tensor, Tensor]:
        """Actions of the policy along rows [B, T, D], and their log-densities."""
        noise = torch.randn(*z.shape[:2], self.model.action_dim, generator=self.generator, device=self.device)
        return gaussian_tanh(*self.model.moments_along(z, begins), noise)

    def _known(self, x: Tensor) -> Tensor:
        """What the simulator knows, of about unit size: places of draws lie in [0, 1]."""
        raw, norm = int(self.model.sizes["decode_dim"]), self.model.normalizer
        truth = ((x[..., :raw] - norm.mean[:raw]) / norm.std[:raw]).clamp(-norm.limit, norm.limit)
        return torch.cat([truth, 2 * x[..., raw:] - 1], -1)

    def _worth(self, critics: nn.Module, z: Tensor, known: Tensor, action: Tensor) -> Tensor:
        """Q of both critics, [2, B, T]."""
        return self.model.two_hot.decode(critics(torch.cat([z, known, action], -1)))

    def _descend(self, name: str, loss: Tensor) -> None:
        """A step of one optimiser down its loss."""
        check_finite({f"loss of the {name}": loss})
        parameters = self.optimizers[name].param_groups[0]["params"]
        self.optimizers[name].zero_grad()
        loss.backward(inputs=parameters)
        nn.utils.clip_grad_norm_(parameters, self.grad_clip, foreach=True)
        self.optimizers[name].step()


def _mean(loss: Tensor, counts: Tensor) -> Tensor:
    """Mean over the steps that count, of losses [..., B, T]."""
    return (loss * counts).mean() / counts.mean().clamp_min(1e-6)
