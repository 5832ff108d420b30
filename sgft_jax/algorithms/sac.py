"""SAC with V_sim and a dynamics ensemble: the priors of most methods. Those with a `plan` act by plans."""

from collections.abc import Mapping
from typing import Annotated, Any, NotRequired

from msgspec import Meta, Struct

from envs.types import Array, Policy, PyTree, UserError
from sgft_jax import data, learners
from sgft_jax.algorithms.base import (
    Algorithm,
    Card,
    Config,
    NetworkEntry,
    Networks,
    Recipe,
    VaryingEntry,
    Width,
    scheduled,
)
from sgft_jax.models.config import network_of
from sgft_jax.types import Task


class _Plan(Struct, forbid_unknown_fields=True):
    horizon: Width = 1
    samples: Width = 1
    noise: Annotated[float, Meta(ge=0)] = 0.0


class _Estimator(Struct, forbid_unknown_fields=True):
    unknowns: list[VaryingEntry]
    steps: Width
    measured: Width


class _SACCard(Card):
    network: NetworkEntry
    critic_network: NotRequired[NetworkEntry | None]
    plan: NotRequired[_Plan | None]
    value_system: NotRequired[list[VaryingEntry]]
    estimator: NotRequired[_Estimator | None]


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    from sgft_jax.planning import MPCConfig
    from sgft_jax.policies import mpc_policy, sac_policy

    network = network_of(card)
    if plan := card.get("plan"):
        return mpc_policy(MPCConfig(task.obs_dim, task.act_dim, network, **plan, gamma=card["gamma"]), task)
    return sac_policy(task.obs_dim, task.act_dim, network)


def _networks(card: Mapping[str, Any], params: Any) -> Networks:
    from sgft_jax.models import networks

    sizes, network = (card["obs_dim"], card["act_dim"]), network_of(card)
    yield "actor", networks.make_actor(*sizes, network), params.actor
    if params.critic is not None:
        twin = networks.make_critic(*sizes, network_of(card, "critic_network"), members=_members(params.critic))
        yield "critic", twin, params.critic
    if params.value is not None:
        yield "value", _value_network(card, params.value), params.value
    if params.dynamics is not None:
        ensemble = networks.make_dynamics(*sizes, network, members=_members(params.dynamics))
        yield "dynamics", ensemble, params.dynamics
    if params.estimator is not None:
        yield "estimator", _estimator(card), params.estimator


def _estimator(card: Mapping[str, Any]) -> Any:
    """Of the shapes that a card tells; raises UserError where it tells nothing of an estimator."""
    from sgft_jax.models.networks import Network
    from sgft_jax.posterior.estimator import shaped

    if not (entry := card.get("estimator")):
        raise UserError("has an estimator, of which its card says nothing; make it anew, or take another prior")
    sizes = entry["steps"], entry["measured"], card["act_dim"], len(entry["unknowns"])
    return Network(lambda key: shaped(*sizes), lambda params, *inputs: params)


def _value_network(card: Mapping[str, Any], params: PyTree) -> Any:
    """An ensemble that can be told what the card lists; of older cards one network of observations alone."""
    from sgft_jax.models import networks, value

    obs_dim, network, system = card["obs_dim"], network_of(card), card.get("value_system")
    if system is None:
        return networks.make_value(obs_dim, network)
    return value.make_v_sim(obs_dim, network, system=len(system), members=_members(params))


def _members(ensemble: PyTree) -> int:
    """How many networks an ensemble has; methods may keep fewer or more than the prior had."""
    import jax

    return next(iter(jax.tree.leaves(ensemble)[0].shape), 1)


def _recipe(task: Task, config: Config) -> Recipe:
    """One learning rate for all networks, as in the paper."""
    sac = learners.sac

    def numbers(rate: Array) -> Any:
        rates = dict.fromkeys(("lr_actor", "lr_critic", "lr_dynamics", "lr_alpha"), rate)
        return sac.SACHyper(**rates, tau=config.tau, alpha=config.alpha, entropy_per_dim=config.entropy_per_dim)

    shared = {name: getattr(config, name) for name in ("network", "ensemble_size", "policy_delay")}
    hyper = scheduled(config, numbers)
    learner = sac.make_sac(sac.SACConfig(task.obs_dim, task.act_dim, **shared), hyper(0))
    return Recipe(learner, data.memory.transitions(task), hyper, sac.extract_params, valued=True)


ALGORITHM = Algorithm("sac", _SACCard, lambda: learners.sac.SACParams, _policy, _networks, _recipe, preset="robust")
