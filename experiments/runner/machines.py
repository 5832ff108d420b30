"""Impure: the machines of a run: whether it fits into the memory of the devices, and several hosts together.

All hosts run the same program, each on its own devices. The first host writes the run folder. The others write to a
temporary folder, so other modules need no special case for them.
"""

import contextlib
import os
import re
import shutil
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax

from envs import mesh
from envs.types import UserError
from experiments.runner import progress
from experiments.runner.cli import USER_ERROR
from experiments.runner.options import hosts_of

_TOGETHER = ("checkpoints", "random", "prior")


def join_hosts(hosts: str | None) -> None:
    """Connects to the other hosts, before JAX is used for anything; None: there are no others.

    hosts: `auto` asks the cluster that started this process (SLURM, Open MPI, Kubernetes, as JAX detects them);
    `ADDRESS:PORT,COUNT,INDEX` says where the first host listens, how many there are, and which one this is. Raises
    UserError for anything else, and if there is no cluster to ask.
    """
    if hosts is None or jax.distributed.is_initialized():
        return
    if hosts == "auto":
        try:
            jax.distributed.initialize()
        except (RuntimeError, ValueError) as error:
            raise UserError(f"--hosts auto: {str(error).splitlines()[0]}") from error
        return
    jax.distributed.initialize(*hosts_of(hosts))


@contextlib.contextmanager
def folder_of_host(folder: Path) -> Iterator[Path]:
    """Where this host writes the run of that folder: there on the first host, elsewhere and silently on the others.

    They begin with a copy of its logs, so that all can resume. Checkpoints and priors are not for here: hosts save and
    read them together, in the folder itself, so the file system must be one that all hosts share.
    """
    if jax.process_count() == 1:
        yield folder
        return
    with contextlib.ExitStack() as stack:
        mine = folder
        if jax.process_index():
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
            progress.say_nothing()
            mine = Path(stack.enter_context(tempfile.TemporaryDirectory())) / folder.name
            if folder.exists():
                shutil.copytree(folder, mine, ignore=shutil.ignore_patterns(*_TOGETHER))
        mesh.meet()  # from here on the first host may change its folder
        try:
            yield mine
        except UserError:
            if jax.process_index():
                sys.exit(USER_ERROR)  # the first host says the same of the folder that is meant
            raise
        except Exception:
            traceback.print_exc()
            os._exit(1)  # an orderly exit would wait minutes for the other hosts, which wait for this one


def reserve(
    parts: Mapping[str, int], *, copies: int, devices: int = 1, shared: int = 0, settings: str = "config"
) -> None:
    """Prints how much memory each device will need; raises UserError if it is more than the device has room for.

    parts: bytes of one agent's by the setting that decides them. copies: agents trained together. shared: bytes of data
    that they all read. settings: the group of options that these settings belong to.
    """
    share = {name: copies * size / devices for name, size in parts.items()}
    need, room = sum(share.values()) + shared, free_memory()
    free = "" if room is None else f", {_gib(room)} free"
    data = {"data": shared} if shared else {}
    listed = ", ".join(f"{name} {_gib(size)}" for name, size in (share | data).items())
    print(f"memory: {_gib(need)} needed on each device{free} ({listed})")
    if room is not None and need > room:
        option = max(share, key=share.__getitem__).replace("_", "-")
        raise UserError(
            f"experience and batches take {_gib(need)} on each device{free}: lower --{settings}.{option} or train fewer"
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
