"""SAC of other libraries, ready to train on made-up experience.

None of them is needed to use this repository; the benchmark measures those that it finds installed.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

LIBRARIES = ("stable_baselines3", "sbx")  # on PyTorch; the same interface on JAX


def importable() -> Iterator[str]:
    """Those that are here; says why one that is installed cannot be used, as when it was made for another JAX."""
    for library in LIBRARIES:
        if importlib.util.find_spec(library):
            try:
                importlib.import_module(library)
            except Exception as error:  # whatever somebody else's package stumbles over
                print(f"{library} is installed but left out: {type(error).__name__}: {error}")
            else:
                yield library


def make(library: str, batch: int, width: int, obs_dim: int, act_dim: int, capacity: int) -> Callable[[int], Any]:
    """train(updates) of an agent on its library's default device, its replay full of noise; it writes no log."""
    gymnasium = importlib.import_module("gymnasium")

    class Sizes(gymnasium.Env):
        """An environment that only says how large things are."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (act_dim,), np.float32)

    agent = importlib.import_module(library).SAC(
        "MlpPolicy", Sizes(), batch_size=batch, buffer_size=capacity, policy_kwargs={"net_arch": [width, width]}
    )
    agent.set_logger(importlib.import_module("stable_baselines3.common.logger").Logger(None, []))
    rng = np.random.default_rng(0)
    for _ in range(capacity):
        obs, next_obs = rng.standard_normal((2, 1, obs_dim), np.float32)
        action = rng.uniform(-1, 1, (1, act_dim)).astype(np.float32)
        agent.replay_buffer.add(obs, next_obs, action, np.zeros(1), np.zeros(1), [{}])
    return lambda updates: agent.train(gradient_steps=updates, batch_size=batch)
