"""Learning algorithms, one module each: pure functions of one agent, for `jax.jit`, `jax.vmap` and `jax.lax.scan`.

Each module has a frozen configuration (structure, static), numbers that are leaves of its state, and

    state = init(config, key, hyper)
    action, carry = act(config, state, carry, obs, key, explore=True)
    state, metrics = update(config, state, batch, key)

hyper: the numbers, or what has them as attributes, such as a method's options; None = the defaults.
`make_*(config, hyper)` binds them to a configuration, as a `Learner`. A module is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
