"""The memory: its gates against Flax's own cell."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from sgft_jax.models.gru import make_gru

UNITS, OBS, ACT = 4, 3, 2


def test_a_step_is_that_of_a_gru(key):
    """Flax's cell has the same gates; of the biases beside the state it has that of the candidate alone."""
    memory = make_gru(OBS, ACT, UNITS)
    params = jax.tree.map(lambda x: x + 0.1, memory.init(key))
    params["recurrent"]["bias"] = params["recurrent"]["bias"].at[: 2 * UNITS].set(0.0)
    hidden, previous, obs = (
        jax.random.normal(k, (n,)) for k, n in zip(jax.random.split(key, 3), (UNITS, ACT, OBS), strict=True)
    )

    def dense(name, x):
        return nn.relu(x @ params[name]["kernel"] + params[name]["bias"])

    read = jnp.concatenate([dense("action", previous), dense("obs", obs)])

    def split(name):
        return [
            {"kernel": kernel, "bias": bias}
            for kernel, bias in zip(*(jnp.split(params[name][x], 3, axis=-1) for x in ("kernel", "bias")), strict=True)
        ]

    layers = dict(zip(("ir", "iz", "in"), split("inputs"), strict=True)) | dict(
        zip(("hr", "hz", "hn"), split("recurrent"), strict=True)
    )
    for name in ("hr", "hz"):
        del layers[name]["bias"]
    wanted, _ = nn.GRUCell(UNITS).apply({"params": layers}, hidden, read)
    found, handed_on = memory.step(params, hidden, previous, obs)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(handed_on, jnp.concatenate([found, dense("shortcut", obs)]), rtol=1e-5, atol=1e-6)


def test_weights_of_the_state_are_orthogonal_at_first(key):
    kernel = make_gru(OBS, ACT, UNITS).init(key)["recurrent"]["kernel"]
    np.testing.assert_allclose(kernel @ kernel.T, jnp.eye(UNITS), atol=1e-5)
