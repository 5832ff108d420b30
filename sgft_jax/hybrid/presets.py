"""Which preset of a method suits a data set, by the name of that. Pure; imports no JAX: command lines read it."""

import re

from sgft_jax.types import Fixed

_GOES_ON = r"(?!-(?:replay|expert)\b)"  # halfcheetah-medium-replay and -medium-expert are not halfcheetah-medium


def preset_for(method: Fixed, data: str) -> str:
    """The preset of a method with presets `by_data` that is called after this data set; "" for its first one.

    data: a name such as `walker2d_medium-v2`, in which the data set stands between other words. The longest fits best.
    """
    fitting = [name for name in method.presets if _names(data, name)] if method.by_data else []
    return max(fitting, key=len, default="")


def say_preset(method: Fixed, preset: str, data: str) -> str:
    """Which preset a method with presets `by_data` uses, in words. preset: its name, "" for the first."""
    if preset:
        return f"preset {preset}"
    return f"preset {next(iter(method.presets))}, as none is called after {data}"


def _names(data: str, preset: str) -> bool:
    """Whether the name of the data has that of the preset as whole words."""
    words = re.sub(r"[^a-z0-9]+", "-", data.lower())
    return re.search(rf"\b{re.escape(preset)}\b{_GOES_ON}", words) is not None
