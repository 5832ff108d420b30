"""Impure: one run on several hosts. All of them run the same program, each on its own devices. The first
host writes the run folder. The others write to a temporary folder, so other modules need no special case for them.
"""

import contextlib
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

import jax

from envs import mesh
from envs.types import UserError
from experiments.runner.cli import USER_ERROR
from experiments.runner.options import hosts_of

_TOGETHER = ("checkpoints", "random", "prior")


def join(hosts: str | None) -> None:
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
def run_folder(folder: Path) -> Iterator[Path]:
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
