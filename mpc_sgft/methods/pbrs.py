"""Potential-based reward shaping: soft actor-critic whose rewards hold the gain of the simulator's value."""

from mpc_sgft.learning.actor_critic import Transitions, forget_critics, shaped
from mpc_sgft.learning.agent import Agent
from mpc_sgft.learning.observation_map import Sensed
from mpc_sgft.methods.sac import SAC


class PBRS(SAC):
    """`SAC`, with critics that begin at zero, on

        rbar = r + gamma (1 - terminated) V_sim(z') - V_sim(z)

    to the end of the episode: the best policy stays that of r. Arguments as `SAC`.

    Source: Ng, Harada, Russell, ICML 1999, with the potential that SGFT takes.
    """

    def take_over(self, agent: Agent, sensed: Sensed) -> None:
        super().take_over(agent, sensed)
        forget_critics(agent.model)

    def transitions(self, agent: Agent, found: Transitions) -> Transitions:
        return shaped(agent.model, found, agent.discount)
