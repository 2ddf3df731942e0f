"""The TD-MPC2 world model with one addition, a state-value head. Satisfies `planners.base.Model` by having its methods.

    z = encode(o)    z' = next(z, a)    r = reward(z, a, z')    V(z)    Q_e(z, a)    a = policy(z)    o = decode(z)

Source: TD-MPC2, arXiv:2310.16828. V(z) is ours: the potential and terminal value of SGFT (Yin et al., ICLR 2025) must
be one frozen, deterministic function of the latent; Q(z, pi(z)) would move with the policy that keeps training.
"""

import copy
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from mpc_sgft.learning.dynamics import CommandMap, Dynamics
from mpc_sgft.learning.gaussian import gaussian_tanh, gaussian_tanh_log_prob
from mpc_sgft.learning.layers import (
    Ensemble,
    Normalizer,
    SimNorm,
    TwoHot,
    by_blocks,
    mlp,
)
from mpc_sgft.learning.observation_map import ObservationMap
from mpc_sgft.learning.plan_values import PlanValues, PlanWeights
from mpc_sgft.learning.precision import dtype_of_products
from mpc_sgft.learning.recurrent_policy import RecurrentPolicy
from planners.base import step_by_step

PARTS = (
    "normalizer",
    "encoder",
    "dynamics",
    "reward_head",
    "q_ensemble",
    "target_q",
    "value_head",
    "policy_head",
    "decoder",
)
REWARD_FROM = ("next", "current")
TERMINALS = ("value", "q")
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0


class WorldModel(nn.Module):
    """Everything that is learned. All methods take any leading batch dimensions [...].

    Args:
        obs_dim: Entries of an observation, history included [O].
        action_dim: Entries of an action [A].
        decode_dim: Leading observation entries that `decode` returns (the raw observation without history).
        latent_dim: Entries of the code that the encoder makes, a multiple of simnorm_dim.
        memory_dim: Last entries of the observation, past actions newest first, that the latent carries as they are. A
            latent then has D = latent_dim + memory_dim entries, and the dynamics need not learn to remember.
        mlp_dim: Hidden size of the heads.
        enc_dim: Hidden size of the encoder.
        enc_layers: Hidden layers of the encoder.
        num_q: Members of the critic ensemble [E].
        simnorm_dim: Entries of one SimNorm group.
        num_bins: Two-hot bins of reward and value.
        vmin: Lowest bin, on a symlog scale.
        vmax: Highest bin.
        dropout: Probability on the first layer of every critic while training.
        reward_from: "next": reward is read from the latent it is received in, so that it cannot hide the simulator's
            dynamics; "current": from (z, a), as TD-MPC2 has it.
        terminal: What an imagined plan ends in: the "value" head, or "q", the mean of the target critics at the action
            of the policy, as TD-MPC2 has it (there of two critics that drop out).
        recurrent_dim: Entries of the memory of a policy that stands beside the policy prior; 0: there is none.

    Raises:
        ValueError: If latent_dim is no multiple of simnorm_dim, decode_dim exceeds obs_dim, num_q < 2, or reward_from
            or terminal is unknown.
    """

    def __init__(
        self,
        *,
        obs_dim: int,
        action_dim: int,
        decode_dim: int,
        latent_dim: int,
        memory_dim: int = 0,
        mlp_dim: int,
        enc_dim: int,
        enc_layers: int = 2,
        num_q: int,
        simnorm_dim: int = 8,
        num_bins: int = 101,
        vmin: float = -10.0,
        vmax: float = 10.0,
        dropout: float = 0.01,
        reward_from: str = "next",
        terminal: str = "value",
        recurrent_dim: int = 0,
    ) -> None:
        self_sizes = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        super().__init__()
        if latent_dim % simnorm_dim:
            raise ValueError(f"latent_dim={latent_dim} is not a multiple of simnorm_dim={simnorm_dim}.")
        if memory_dim % action_dim or not 0 <= memory_dim < obs_dim:
            raise ValueError(
                f"memory_dim={memory_dim} must be whole actions (action_dim={action_dim}) of the observation."
            )
        if not 1 <= decode_dim <= obs_dim:
            raise ValueError(f"decode_dim={decode_dim} must lie between 1 and obs_dim={obs_dim}.")
        if num_q < 2:
            raise ValueError(f"num_q={num_q}: the target is the minimum of two critics, so at least 2 are needed.")
        if reward_from not in REWARD_FROM:
            raise ValueError(f"reward_from={reward_from!r}. Available: {', '.join(REWARD_FROM)}.")
        if terminal not in TERMINALS:
            raise ValueError(f"terminal={terminal!r}. Available: {', '.join(TERMINALS)}.")
        self.sizes: dict[str, int | float | str] = self_sizes  # what rebuilds this model: WorldModel(**sizes)
        self.obs_dim, self.action_dim, self.memory_dim = obs_dim, action_dim, memory_dim
        self.latent_dim = latent_dim + memory_dim
        self.num_q, self.reward_from = num_q, reward_from
        self.value_range = 1.0  # of the critics over what pretraining saw, 5 to 95 %, reward units

        code_dim, latent_dim = latent_dim, self.latent_dim
        pair = latent_dim + action_dim
        self.two_hot = TwoHot(num_bins, vmin, vmax)
        self.normalizer = Normalizer(obs_dim)
        self.encoder = mlp([obs_dim - memory_dim, *[enc_dim] * enc_layers, code_dim], out=SimNorm(simnorm_dim))
        self.observation_map: ObservationMap | None = None
        self.dynamics = Dynamics(code_dim, memory_dim, action_dim, mlp_dim, simnorm_dim)
        self.reward_head = mlp([pair, mlp_dim, mlp_dim, num_bins], zero_out=True)
        self.q_ensemble = Ensemble(
            mlp([pair, mlp_dim, mlp_dim, num_bins], dropout=dropout, zero_out=True) for _ in range(num_q)
        )
        self.target_q = copy.deepcopy(self.q_ensemble).requires_grad_(False)
        self.value_head = mlp([latent_dim, mlp_dim, mlp_dim, num_bins], zero_out=True)
        self.policy_head = mlp([latent_dim, mlp_dim, mlp_dim, 2 * action_dim])
        self.recurrent_policy: RecurrentPolicy | None = None
        if recurrent_dim:
            self.recurrent_policy = RecurrentPolicy(latent_dim, recurrent_dim, mlp_dim, action_dim)
        self.decoder = mlp([latent_dim, mlp_dim, decode_dim])

    # -- what a planner calls ------------------------------------------------------------------------------------------

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Latent after `action` [..., A] in latent `z` [..., D]: [..., D]."""
        return by_blocks(self.dynamics, z, action)

    def reward(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        """Expected reward of the transition, reward units, [...]."""
        seen = next_z if self.reward_from == "next" else z
        return by_blocks(lambda s, a: self.two_hot.decode(self.reward_head(torch.cat([s, a], -1))), seen, action)

    def terminal_value(self, z: Tensor) -> Tensor:
        """V(z), discounted reward units, [...]; at transfer the frozen V sees each command as it was realised."""
        if self.sizes["terminal"] == "q":
            return by_blocks(lambda s: self.q(s, self.policy_prior(s, None), target=True).mean(0), z)
        return by_blocks(lambda s: self.two_hot.decode(self.value_head(self.dynamics.as_simulated(s))), z)

    def policy_prior(self, z: Tensor, noise: Tensor | None) -> Tensor:
        """Action of the policy in [-1, 1], [..., A]; noise None gives tanh of the mean."""
        mean, log_std = self._policy_moments(z)
        return torch.tanh(mean if noise is None else mean + log_std.exp() * noise)

    def neutral_action(self) -> Tensor | None:
        """The command that the machine makes nothing of, [A]; None without a command map. See `Dynamics`."""
        return self.dynamics.neutral_action()

    def recurrent_action(
        self, z: Tensor, memory: Tensor | None, begins: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """As `policy_prior`, of the policy that remembers, and its new memory; see `RecurrentPolicy`."""
        assert self.recurrent_policy is not None
        moments, after = self.recurrent_policy(z, memory, begins)
        mean, log_std = _moments(moments)
        return torch.tanh(mean if noise is None else mean + log_std.exp() * noise), after

    def plan_values(self, z: Tensor, discount: float, precision: str, rows: int) -> Callable[[Tensor], Tensor]:
        """Values many plans from the latents z [B, D] at once, in the precision of configs/planner/mppi.yaml.

        With `terminal` "q" step by step, in float32.
        """
        if self.sizes["terminal"] == "q":
            return step_by_step(self, z, discount, rows)
        dtype = dtype_of_products(precision, int(self.sizes["mlp_dim"]), z.device)
        heads = self.reward_head, self.value_head
        weights = PlanWeights(self.dynamics, *heads, self.two_hot, reward_from=self.reward_from, dtype=dtype)
        return PlanValues(weights, z, discount, rows)

    # -- what learning calls -------------------------------------------------------------------------------------------

    def encode(self, observation: Tensor) -> Tensor:
        """Latent of a raw observation, [..., O] -> [..., D]."""
        return self.encode_corrected(self.corrected(observation))

    def corrected(self, observation: Tensor, *, suspected: bool | None = None) -> Tensor:
        """What the sensors should have said, [..., O] -> [..., O]; `suspected` as in the observation map."""
        if self.observation_map is None:
            return observation
        return self.observation_map(observation, suspected=suspected)

    def encode_corrected(self, observation: Tensor) -> Tensor:
        """Latent of what `corrected` gives, [..., O] -> [..., D]."""
        seen = self.obs_dim - self.memory_dim
        code = by_blocks(lambda o: self.encoder(self.normalizer(o)[..., :seen]), observation)
        return torch.cat([code, observation[..., seen:]], -1) if self.memory_dim else code

    def decode(self, z: Tensor) -> Tensor:
        """Leading entries of the observation in raw units, [..., decode_dim]. Never trains the latent."""
        return self.normalizer.inverse(self.decoder(z.detach()))

    def reward_logits(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        """Two-hot logits of the reward, [..., num_bins]."""
        return self.reward_head(torch.cat([next_z if self.reward_from == "next" else z, action], -1))

    def q_logits(
        self, z: Tensor, action: Tensor, *, target: bool = False, heads: Sequence[int] | Tensor | None = None
    ) -> Tensor:
        """Two-hot logits of the chosen critics (all by default), [E, ..., num_bins]."""
        return (self.target_q if target else self.q_ensemble)(torch.cat([z, action], -1), heads)

    def q(
        self, z: Tensor, action: Tensor, *, target: bool = False, heads: Sequence[int] | Tensor | None = None
    ) -> Tensor:
        """Q of the chosen critics (all by default), [E, ...]."""
        return self.two_hot.decode(self.q_logits(z, action, target=target, heads=heads))

    def policy(self, z: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Reparameterised action [..., A] and its exact log-density [...]; noise is standard normal [..., A]."""
        return gaussian_tanh(*self._policy_moments(z), noise)

    def log_prob(self, z: Tensor, action: Tensor) -> Tensor:
        """Log-density of an action [..., A] under the policy, [...]."""
        return gaussian_tanh_log_prob(*self._policy_moments(z), action)

    def _policy_moments(self, z: Tensor) -> tuple[Tensor, Tensor]:
        return _moments(by_blocks(self.policy_head, z))

    def moments_along(self, z: Tensor, begins: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-deviation before the tanh of the policy that acts along rows of latents [B, T, D].

        Args:
            z: Latents.
            begins: Where an episode begins, bool [B, T]; a policy with a memory forgets what was before.
        """
        if self.recurrent_policy is None:
            return self._policy_moments(z)
        return _moments(self.recurrent_policy.along(z, begins))

    # -- changes of the model itself -----------------------------------------------------------------------------------

    def begin_policy(self, memory_dim: int) -> nn.Module:
        """A policy that has learned nothing: the policy prior anew, or with a memory another one beside it.

        Args:
            memory_dim: Entries of the memory; 0: none.

        Returns:
            The part that is new.

        Raises:
            ValueError: If there is a policy with a memory already.
        """
        if self.recurrent_policy is not None:
            raise ValueError("The model has a policy with a memory; begin with a checkpoint without.")
        hidden, device = int(self.sizes["mlp_dim"]), next(self.parameters()).device
        if not memory_dim:
            self.policy_head = mlp([self.latent_dim, hidden, hidden, 2 * self.action_dim]).to(device)
            return self.policy_head
        self.sizes["recurrent_dim"] = memory_dim
        self.recurrent_policy = RecurrentPolicy(self.latent_dim, memory_dim, hidden, self.action_dim).to(device)
        return self.recurrent_policy

    def add_residual(self, mlp_dim: int = 64) -> None:
        """Freeze the dynamics and add a trainable correction to its logits that starts at exactly zero.

        Raises:
            ValueError: If there is one already.
        """
        if self.dynamics.residual is not None:
            raise ValueError("The dynamics already have a residual; add_residual works once.")
        self.dynamics.base.requires_grad_(False)
        pair = self.latent_dim + self.action_dim
        residual = mlp([pair, mlp_dim, self.dynamics.code_dim], zero_out=True)
        self.dynamics.residual = residual.to(next(self.parameters()).device)

    @torch.no_grad()
    def add_command_map(self) -> CommandMap:
        """Let the dynamics learn what the machine makes of a command, and give the map; starts as exactly the identity.

        Raises:
            ValueError: If there is one already.
        """
        if self.dynamics.command is not None:
            raise ValueError("The dynamics already have a command map; add_command_map works once.")
        self.dynamics.command = self._new_command_map(band=False)
        return self.dynamics.command

    def add_command_band(self) -> CommandMap:
        """Let a second command map learn beside the first, with a dead band; it does not act yet. Gives the map.

        Raises:
            ValueError: If there is one already, or no first.
        """
        dynamics = self.dynamics
        if dynamics.command is None or dynamics.banded is not None:
            raise ValueError("A second command map needs a first: add_command_map, then add_command_band, each once.")
        dynamics.banded = self._new_command_map(band=True)
        dynamics.register_buffer("band_acts", torch.tensor(False, device=dynamics.banded.bias.device))
        return dynamics.banded

    def add_suspicion(self) -> None:
        """Let another command map learn together with what sensors are suspected of; nothing of it acts yet.

        Without a command map there is nothing to add: what is suspected then explains alone.

        Raises:
            ValueError: If there is one already, or no observation map.
        """
        dynamics = self.dynamics
        if self.observation_map is None or dynamics.joint is not None:
            raise ValueError("Only an observation map suspects: add_observation_map, then add_suspicion, each once.")
        if dynamics.command is not None:
            dynamics.joint = self._new_command_map(band=False)
            dynamics.register_buffer("joint_acts", torch.tensor(False, device=dynamics.joint.bias.device))

    def use_band(self, acts: bool) -> None:
        """Whether the command map with a dead band acts in place of the first."""
        self.dynamics.band_acts.fill_(acts)

    def suspect(self, acts: bool) -> None:
        """Whether what sensors are suspected of acts, with the command map that goes with it.

        Raises:
            ValueError: If there is no observation map.
        """
        if self.observation_map is None:
            raise ValueError("Only an observation map suspects sensors: add_observation_map makes one.")
        self.observation_map.suspects.fill_(acts)
        if self.dynamics.joint is not None:
            self.dynamics.joint_acts.fill_(acts)

    def _new_command_map(self, *, band: bool) -> CommandMap:
        sizes = self.action_dim + self.memory_dim, self.action_dim
        return CommandMap(*sizes, band=band).to(next(self.parameters()).device)

    @torch.no_grad()
    def add_observation_map(self, points: list[list[int]]) -> None:
        """Let the encoder be told what the sensors should have said; starts as exactly the identity.

        Args:
            points: Pairs of leading observation entries that are the x and y of a point.

        Raises:
            ValueError: If there is one already.
        """
        if self.observation_map is not None:
            raise ValueError("The model already has an observation map; add_observation_map works once.")
        raw = int(self.sizes["decode_dim"])
        blocks = (self.obs_dim - self.memory_dim) // raw
        centre, unit = self.normalizer.mean[:raw], self.normalizer.std[:raw]
        self.observation_map = ObservationMap(points, centre, unit, blocks).to(centre.device)

    @torch.no_grad()
    def update_targets(self, rate: float) -> None:
        """Move the target critics toward the critics: target += rate (critic - target)."""
        for target, critic in zip(self.target_q.parameters(), self.q_ensemble.parameters(), strict=True):
            target.lerp_(critic, rate)

    def train(self, mode: bool = True) -> "WorldModel":
        """Training mode (dropout in the critics); the target critics never drop out."""
        super().train(mode)
        self.target_q.eval()
        return self

    def __repr__(self) -> str:
        count = {part: sum(p.numel() for p in getattr(self, part).parameters()) for part in PARTS}
        lines = [f"  {part:<12}{n:>12,}" for part, n in count.items() if n]
        total = sum(n for part, n in count.items() if part != "target_q")
        return "\n".join([f"WorldModel({total:,} parameters without targets)", *lines])


def _moments(head: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log-deviation, each [..., A], of what a policy's last layer says, [..., 2 A]."""
    mean, log_std = head.chunk(2, -1)
    return mean, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(log_std) + 1)
