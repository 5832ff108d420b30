"""An asymmetric actor-critic: its actor cannot read the end of an observation, its critic can."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.methods import get_method
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import make_actor, make_critic
from sgft_jax.presets import PRESETS, check_card, preset_of

CONFIG = NetworkConfig(hidden=(16,), blind=3)


def test_the_actor_does_not_see_what_the_critic_sees():
    key, obs = jax.random.key(0), jnp.arange(8.0) / 8
    actor, critic = make_actor(8, 2, CONFIG), make_critic(8, 2, CONFIG)
    acts = jax.jacobian(lambda obs: actor.apply(actor.init(key), obs))(obs)
    values = jax.jacobian(lambda obs: critic.apply(critic.init(key), obs, jnp.zeros(2)))(obs)
    assert not acts[..., 5:].any() and acts[..., :5].any()
    assert np.abs(values).min(axis=0).any() and values[:, 5:].any()


def card(**changes):
    return {"algorithm": "sac", "task": "push", "system": [], "network": {"hidden": [16]}} | changes


def test_priors_of_blind_actors_are_for_this_method_alone():
    told = [{"name": "table_friction", "index": 0, "low": 0.1, "high": 0.2}]
    blind, seeing = ({"hidden": [16], "blind": n} for n in (1, 0))
    asymmetric, sysid = get_method("asymmetric"), get_method("sysid")
    check_card(card(system=told, network=blind), asymmetric, "push")
    check_card(card(system=told, network=seeing), sysid, "push")
    for network, method in ((seeing, asymmetric), (blind, sysid)):
        with pytest.raises(UserError, match=rf"{method.name} needs .* --preset {preset_of(method)}"):
            check_card(card(system=told, network=network), method, "push")
    with pytest.raises(UserError, match="needs a prior that was told the system"):
        check_card(card(), asymmetric, "push")
    assert PRESETS["asymmetric"].blind_actor and PRESETS["asymmetric"].sees_system
