"""Impure: whether what a run keeps and computes fits into the memory of its devices."""

import re
from collections.abc import Mapping
from pathlib import Path

import jax

from envs.types import UserError


def reserve(
    parts: Mapping[str, int], *, copies: int, devices: int = 1, shared: int = 0, settings: str = "config"
) -> None:
    """Prints how much memory each device will need; raises UserError if it is more than the device has room for.

    parts: bytes of one agent's by the setting that decides them. copies: agents trained together. shared: bytes of data
    that they all read. settings: the group of options that these settings belong to.
    """
    share = {name: copies * size / devices for name, size in parts.items()}
    need, room = sum(share.values()) + shared, free_memory()
    free = "" if room is None else f" of {_gib(room)} free"
    data = {"data": shared} if shared else {}
    listed = ", ".join(f"{name} {_gib(size)}" for name, size in (share | data).items())
    print(f"memory: {_gib(need)}{free} on each device ({listed})")
    if room is not None and need > room:
        option = max(share, key=share.__getitem__).replace("_", "-")
        raise UserError(
            f"experience and batches take {_gib(need)}{free} on each device: lower --{settings}.{option} or train fewer"
        )


def free_memory() -> int | None:
    """Bytes that the first device can still hold; None where the device does not report it."""
    if stats := jax.local_devices()[0].memory_stats():
        return stats["bytes_limit"] - stats["bytes_in_use"]
    table = Path("/proc/meminfo")
    available = re.search(r"MemAvailable:\s+(\d+) kB", table.read_text()) if table.exists() else None
    return int(available[1]) * 1024 if available else None


def _gib(size: float) -> str:
    return f"{size / 2**30:.2f} GiB"
