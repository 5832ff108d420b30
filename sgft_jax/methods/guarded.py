"""The default method: SAC in the simulator's own commands, on half simulated batches, behind a guard.

What it is made of, each an option that other methods have too, and what it is for (docs/rules.md has the numbers):

- `identify`: scale, rotation and bias of commands and constant errors of sensors are fitted to the rollouts, and what
  learns acts in the simulator's commands and measurements. Most gaps are solved by that alone.
- `simulated_share`: half of each batch is simulated, so the critic does not forget what real rows do not show.
- `guard`: a policy is deployed only while its real rollouts say that it is better than the one that is known.

Shaped rewards and short horizons are not in it: with these in place they changed nothing that was measured. Nor is the
price for leaving the simulator's policy (`anchor`): behind the guard it cost more than it saved.
"""

from dataclasses import dataclass

from sgft_jax.methods import sac
from sgft_jax.types import Method, Online


@dataclass(frozen=True)
class Config(sac.Config):
    """Options of `guarded`."""

    utd: float = 8.0
    """Gradient updates per real transition."""
    identify: bool = True
    simulated_share: float = 0.5
    guard: bool = True


_ABOUT = "the default: SAC in identified commands, half simulated, deployed by a guard"
METHOD = Method("guarded", Online("model-free", _ABOUT, "ours", Config, sac.build))
