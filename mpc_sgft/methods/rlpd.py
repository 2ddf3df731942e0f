"""Reinforcement learning with prior data: soft actor-critic on batches of which half is real, half simulated."""

from mpc_sgft.learning.method import check_simulated
from mpc_sgft.methods.sac import SAC


class RLPD(SAC):
    """`SAC`; the simulated half comes from the pretrained policy, exploring as in pretraining.

    What differs from the publication: policy and critics begin as they were pretrained, not anew; the policy climbs the
    lesser of two critics, not the mean of ten; there are as many updates a rollout as for every other method.

    Args:
        simulated_episodes: As in `AbstractMethod`; 0 leaves `SAC`.
        others: As in `SAC`.

    Raises:
        ValueError: If simulated_episodes is negative.

    Source: Ball, Smith, Kostrikov, Levine, ICML 2023, arXiv:2302.02948.
    """

    def __init__(
        self,
        *,
        simulated_episodes: int,
        lr: float,
        policy_lr: float,
        entropy_coef: float,
        updates: int,
        slice_len: int,
        action_noise: float,
    ):
        check_simulated(simulated_episodes, 0)
        numbers = {"updates": updates, "slice_len": slice_len, "action_noise": action_noise}
        super().__init__(lr=lr, policy_lr=policy_lr, entropy_coef=entropy_coef, **numbers)
        self.simulated_episodes = simulated_episodes
