"""Planning by sampling: model predictive path integral control on any score of action sequences.

Source: Williams et al. 2015, as in TD-MPC2 (Hansen et al. 2024): elites alone count, and a policy makes proposals.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, Key, UserError
from sgft_jax import checks
from sgft_jax.models.networks import add_noise

_WORST = -1e9  # finite, so that weights stay defined where no score is


@dataclass(frozen=True)
class MPPIConfig:
    """samples: sequences per iteration, proposals among them. elites: the best of them. iterations: of the search."""

    samples: int = 512
    elites: int = 64
    iterations: int = 6

    def __post_init__(self) -> None:
        checks.at_least(self, 1, "iterations", "elites")
        if self.elites > self.samples:
            raise checks.refusal("elites", self.elites, f"at most samples, {self.samples}")


class MPPIHyper(NamedTuple):
    """The numbers of the search, each [].

    temperature: elites weigh exp(temperature (score - best score)), so larger is greedier; per unit of score.
    std_min, std_max: bounds on the spread of the samples, units of the action's range [-1, 1]; std_max at the start.
    """

    temperature: float | Array = 0.5
    std_min: float | Array = 0.05
    std_max: float | Array = 2.0


class _Search(NamedTuple):
    """mean, std: [H, act_dim] of the next samples. elites: [elites, H, act_dim] with their log-weights [elites]."""

    mean: Array
    std: Array
    elites: Array
    logits: Array


def plan(
    config: MPPIConfig,
    hyper: MPPIHyper,
    score: Callable[[Array], Array],
    proposals: Array,
    previous: Array,
    key: Key,
    *,
    explore: bool | Array,
) -> tuple[Array, Array]:
    """One action [act_dim] in [-1, 1], and the mean [H, act_dim] of the plan, which is the next call's `previous`.

    score(sequence [H, act_dim]) -> []: higher is better; a score that is not finite ranks last. Each of the
        `proposals` is scored once.
    proposals: [n, H, act_dim] sequences in [-1, 1] that compete with the samples, n < samples (n = 0: none).
    previous: [H, act_dim] the last plan; its first step lies in the past by now. Zeros at the start of an episode.
    explore: [] bool, may be traced. Both modes draw one elite by its weight; exploring adds noise of the search's final
        spread. As published: the mean of the elites can lie between two good ways round an obstacle, an elite cannot.
        Evaluation is a function of the key for it, not of the observation alone.
    """
    n = proposals.shape[0]
    if n >= config.samples:
        raise UserError(f"planner: {n} proposals leave none of {config.samples} samples to draw; raise samples")
    key_search, key_pick, key_noise = jax.random.split(key, 3)

    def rate(sequences: Array) -> Array:
        scores = jax.vmap(score)(sequences)
        return jnp.where(jnp.isfinite(scores), scores, _WORST)

    known = rate(proposals) if n else jnp.zeros(0)

    def refine(search: _Search, key: Key) -> tuple[_Search, None]:
        noise = jax.random.normal(key, (config.samples - n, *previous.shape))
        drawn = jnp.clip(jax.vmap(lambda e: search.mean + search.std * e)(noise), -1.0, 1.0)
        candidates = jnp.concatenate([proposals, drawn])
        best, index = jax.lax.top_k(jnp.concatenate([known, rate(drawn)]), config.elites)
        return _fit(candidates[index], hyper.temperature * (best - best[0]), hyper), None

    start = _Search(
        mean=jnp.concatenate([previous[1:], jnp.zeros_like(previous[:1])]),
        std=jnp.full(previous.shape, hyper.std_max),
        elites=jnp.zeros((config.elites, *previous.shape)),
        logits=jnp.zeros(config.elites),
    )
    end, _ = jax.lax.scan(refine, start, jax.random.split(key_search, config.iterations))
    action = end.elites[jax.random.categorical(key_pick, end.logits), 0]
    return add_noise(action, jnp.where(explore, end.std[0], 0.0), key_noise), end.mean


def _fit(elites: Array, logits: Array, hyper: MPPIHyper) -> _Search:
    """Weighted mean and spread of elites [elites, H, act_dim] with log-weights [elites]."""
    weights = jax.nn.softmax(logits)
    mean = jnp.einsum("n,nha->ha", weights, elites)
    variance = jnp.einsum("n,nha->ha", weights, jax.vmap(lambda e: (e - mean) ** 2)(elites))
    return _Search(mean, jnp.clip(jnp.sqrt(variance), hyper.std_min, hyper.std_max), elites, logits)
