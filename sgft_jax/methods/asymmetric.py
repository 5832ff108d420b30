"""An asymmetric actor-critic, zero-shot: in training the critic is told the system, the actor never.

Nothing learns from real rollouts. Source: Pinto et al. 2018, with SAC and domain randomisation (SGFT, section 6.2). Its
V_sim has inputs that no robot measures.
"""

from sgft_jax.methods.recurrent import Config, build
from sgft_jax.types import Method, Online

_ABOUT = "zero-shot: a policy whose critic was told the system"
METHOD = Method(
    "asymmetric", Online("model-free", _ABOUT, "Pinto 2018", Config, build, sees_system=True, blind_actor=True)
)
