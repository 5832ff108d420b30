"""Impure: one run on several hosts. All of them run the same program, each on its own devices; the first one writes it
down. The others write, too, but to a folder that goes when they do, so that hardly anybody need know of them.
"""

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax

from experiments.cli import USER_ERROR
from sgft_jax import mesh
from sgft_jax.types import UserError

LOCAL = "local:"
_TOGETHER = ("checkpoints", "random", "prior")


def run_local(hosts: str, argv: Sequence[str], program: Sequence[str]) -> int:
    """The same command as several processes of this machine, one GPU each; returns the exit code of the first to fail.

    hosts: `local:COUNT`. program: what Python runs, with `argv` and each process's own `--hosts` after it. One process
    for several GPUs is simpler and slower: its threads wait for each other when they launch kernels.
    """
    count = hosts.removeprefix(LOCAL)
    if not count.isdigit() or count == "0":
        raise UserError(f"--hosts {hosts}: must be local:COUNT, with the number of GPUs to use")
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    gpus = [str(i) for i in range(int(count))] if visible is None else visible.split(",")
    if len(gpus) < int(count):
        raise UserError(f"--hosts {hosts}: CUDA_VISIBLE_DEVICES={visible} shows {len(gpus)} GPU(s)")
    meeting = f"127.0.0.1:{free_port()},{count}"
    processes = [
        subprocess.Popen(
            [sys.executable, *program, *argv, "--hosts", f"{meeting},{i}"],
            env={**os.environ, "CUDA_VISIBLE_DEVICES": gpu},
        )
        for i, gpu in enumerate(gpus[: int(count)])
    ]
    try:
        return _first_failure(processes)
    except KeyboardInterrupt:  # the terminal has told the others, too
        return max(process.wait() for process in processes)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _first_failure(processes: Sequence[subprocess.Popen]) -> int:
    """Waits for all, or for one that fails: the others would wait for it for ever."""
    while True:
        codes = [process.poll() for process in processes]
        if any(codes) or None not in codes:
            return next((code for code in codes if code), 0)
        time.sleep(0.1)


def free_port() -> int:
    """A port of this machine at which nobody listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def join(hosts: str | None) -> None:
    """Meets the other hosts, before JAX is used for anything; None: there are no others.

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
    address, *numbers = hosts.split(",")
    if ":" not in address or len(numbers) != 2 or not all(n.isdigit() for n in numbers):
        raise UserError(f"--hosts {hosts}: must be 'auto', local:COUNT or ADDRESS:PORT,COUNT,INDEX")
    count, index = map(int, numbers)
    if index >= count:
        raise UserError(f"--hosts {hosts}: index {index} of {count} hosts; they are counted from 0")
    jax.distributed.initialize(address, count, index)


@contextlib.contextmanager
def own(folder: Path) -> Iterator[Path]:
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
