"""The control: where the real system is the simulator there is nothing to learn, and nothing may be lost.

A small prior pushes a point home in every episode, for a return of 13.3. Deepest fall below that in six rollouts,
of the mean of six seeds:

    method                               return   success
    sac, 24 updates per transition          2.9       8 %
    guarded, but without its guard          0.4       0 %
    guarded, the recommended method         0.0       0 %

`guarded` has its own defaults but for the number of simulated transitions.
"""

import numpy as np
import pytest
import toy

from envs import gaps
from sgft_jax import api
from sgft_jax.methods import DEFAULT
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.presets import PretrainConfig
from sgft_jax.train import finetuning, pretraining

# Rules of the guard by themselves, on scores that are made up: test_guard.py
pytestmark = pytest.mark.slow
ENV, ROLLOUTS, SEEDS = toy.make(), 6, 6
MARGIN, RETURN_MARGIN = 0.03, 0.2  # how far mean success, and the mean return of 13.3, may ever fall
SMALL = {"simulated_transitions": 4000}
HARSH = {"utd": 24.0}  # for `sac`, whose own one update per transition loses little
LOOP = {"env_steps": 45_000, "n_envs": 64, "worlds": 16, "random_transitions": 2000, "random_ladder": 0.5}
LEARNING = {
    "replay_capacity": 20_000,
    "updates_per_step": 2,
    "batch_size": 128,
    "gamma": 0.95,
    "lr": 1e-3,
    "value_episodes": 256,
}
NETWORKS = {"network": NetworkConfig(hidden=(32, 32)), "ensemble_size": 1, "value_updates": 2000}
PRETRAIN = PretrainConfig(**LOOP, **LEARNING, **NETWORKS, alpha=0.1)


@pytest.fixture(scope="module")
def prior():
    """SAC's, after 14 chunks of 64 environments."""
    *_, (state, _) = pretraining.pretrain(ENV, PRETRAIN, [0])
    return pretraining.priors_of(ENV, PRETRAIN, state)[0]


def falls(prior, method, **options):
    """How far mean success and mean return of what is deployed ever fall below the start, on the simulator itself."""
    setup = api.setup(ENV, gaps.load(ENV, "sim"), prior, method=method, seeds=SEEDS, **options)
    found = []
    for progress, _ in finetuning.finetune(*setup, rollouts=ROLLOUTS):
        episodes = finetuning.evaluate(setup.finetuner, setup.system, progress.agent, setup.seeds, 20)
        found.append([episodes.success.mean(), episodes.total_reward.mean()])
    found = np.array(found)  # [evaluations, 2]
    assert len(found) == 1 + ROLLOUTS and found[0, 0] > 0.97  # else there is nothing to lose
    return (found[0] - found).max(0)


def test_where_nothing_is_to_be_learned_the_recommended_method_loses_nothing(prior):
    assert DEFAULT == "guarded"
    success, total = falls(prior, DEFAULT, **SMALL)
    assert success <= MARGIN and total <= RETURN_MARGIN


def test_without_protection_it_is_lost(prior):
    """So the test above can fail."""
    success, total = falls(prior, "sac", **HARSH)
    assert success > MARGIN and total > 4 * RETURN_MARGIN


def test_it_is_the_guard_that_holds_it(prior):
    """Without it the recommended method loses some of the return; with it alone what loses most loses nothing."""
    _, total = falls(prior, DEFAULT, guard=False, **SMALL)
    assert total > RETURN_MARGIN
    success, total = falls(prior, "sac", guard=True, **HARSH)
    assert success <= MARGIN and total <= RETURN_MARGIN
