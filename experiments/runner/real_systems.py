"""What `--real` may name: gaps, Gymnasium environments, or a robot. Imports nothing heavy before one is made."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import json
import os
import re
import secrets
import socket
import stat
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs import extend, gaps
from envs.files import read_text
from envs.gaps import Gap
from envs.types import UserError
from experiments.runner import cli, options
from experiments.runner.options import check_task, port_of
from experiments.runner.progress import amid
from sgft_jax.systems.door import bound, check_host

if TYPE_CHECKING:
    from envs.base import Env
    from sgft_jax.systems.gymnasium import Gymnasium

TOGETHER = "a robot, Gymnasium environments and simulations cannot be played together; run them one after another"
GYMNASIUM = "gymnasium:"  # then a name for `gymnasium.make`, which may begin with the module that registers it
REMOTE = "remote"  # then perhaps where to listen, as `remote:HOST:PORT`
ENOUGH = 10  # rollouts that choose a method
_HOST, _PORT = "127.0.0.1", 8765
_TOKEN = "robot-token"
_LETTERS = re.compile(r"[!-~]{16,256}")  # of a token: so many cannot be guessed


def is_robot(real: str) -> bool:
    """Whether a real system is a robot, or another process, behind a socket."""
    return real == REMOTE or real.startswith(f"{REMOTE}:")


def is_stepped(real: str) -> bool:
    """Whether a real system is played step by step, and no gap of a simulation."""
    return real.startswith(GYMNASIUM) or is_robot(real)


def by_scene(task: str, reals: Sequence[str]) -> list[tuple[str, ...]]:
    """What `--real` names, in the groups that one program can step; see `gaps.by_scene`."""
    groups = gaps.by_scene(reals, lambda real: "" if is_stepped(real) else gaps.find(task, real).scene)
    return [tuple(group) for group in groups]


def title(real: str) -> str:
    """What folders call a real system: `gymnasium-HalfCheetah-v5`, `remote`, or the name of the gap."""
    if is_robot(real):
        return REMOTE
    if not is_stepped(real):
        return gaps.title(real)
    return "gymnasium-" + re.sub(r"[^\w.-]", "-", real.removeprefix(GYMNASIUM).rpartition(":")[2])


def check(task: str, reals: Sequence[str], changes: Sequence[str] = ()) -> None:
    """Raises UserError where there is no such task or real system, or where they cannot be played by one command."""
    stepped, robots = ([real for real in reals if is_kind(real)] for is_kind in (is_stepped, is_robot))
    check_task(task, [real for real in reals if not is_stepped(real)], () if stepped else changes)
    if not stepped:
        return
    if len(stepped) < len(reals) or 0 < len(robots) < len(reals):
        raise UserError(f"--real {' '.join(reals)}: {TOGETHER}")
    if robots:
        _check_robot(robots, changes)
        return
    if importlib.util.find_spec("gymnasium") is None:
        raise UserError(f"--real {stepped[0]}: Gymnasium is not installed; pip install 'sgft-jax[gymnasium]'")
    if GYMNASIUM in stepped:
        raise UserError(f"--real {GYMNASIUM}: name an environment, e.g. {GYMNASIUM}HalfCheetah-v5")
    keywords(changes)
    for real in stepped:
        _explained(real, _registered)


def _check_robot(robots: Sequence[str], changes: Sequence[str]) -> None:
    if len(robots) > 1:
        raise UserError(f"--real {' '.join(robots)}: one robot at a time")
    if changes:
        raise UserError(f"--set {changes[0]}: nothing here can change a robot")
    host, port = address(robots[0])
    try:
        bound(host, port).close()
    except UserError as error:
        raise UserError(f"--real {robots[0]}: {error}") from None


def address(real: str) -> tuple[str, int]:
    """The interface and the port of `remote[:HOST[:PORT]]`; default: this computer alone.

    HOST may be an IPv6 address, in brackets where a port follows. Raises UserError for what is no host or port.
    """
    rest = real.removeprefix(REMOTE).removeprefix(":")
    read = re.fullmatch(r"\[(?P<six>[^\]]*:[^\]]*)\](:(?P<port6>[0-9]*))?|(?P<host>[^:]*)(:(?P<port>[0-9]*))?", rest)
    host, port = (read["six"] or read["host"], read["port6"] or read["port"]) if read else (rest, None)
    number = port_of(port or str(_PORT))
    try:
        check_host(host or _HOST)
    except UserError:
        number = None
    if number is None:
        forms = f"{REMOTE}, {REMOTE}:HOST or {REMOTE}:HOST:PORT"
        raise UserError(f"--real {real}: write {forms}, a port from 1 to 65535, an IPv6 address as [::1]")
    return host or _HOST, number


def free_port() -> int:
    """One of this computer at which nobody listens."""
    with socket.socket() as listener:
        listener.bind((_HOST, 0))
        return listener.getsockname()[1]


def token(home: Path) -> str:
    """What a robot must know, from the file under `home` that only its owner reads; made where there is none.

    It stays the same, so that a robot that waits for a run that was killed is taken again. Runs that begin at the same
    moment agree on one: a file appears as a whole, and only where there is none. Raises UserError for a file that
    others can read or have put there, and for a token that can be guessed; no message holds it.
    """
    path = home / _TOKEN
    if path.is_symlink():
        raise UserError(f"{path}: is a link; delete it for a new token")
    if not path.exists():
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=home, prefix=f".tmp-{_TOKEN}-") as file:  # for its owner alone
            file.write(secrets.token_hex(16) + "\n")
            file.flush()
            with contextlib.suppress(FileExistsError):  # another run was faster
                os.link(file.name, path)
    content = read_text(path, limit=1024).strip()
    if stat.S_IMODE(path.stat().st_mode) & 0o077:
        raise UserError(f"{path}: others can read or write it; delete it for a new token, or chmod 600 it")
    if not _LETTERS.fullmatch(content):
        raise UserError(f"{path}: holds no token: 16 letters, digits or signs, or more; delete it for a new one")
    return content


def keywords(changes: Sequence[str]) -> dict[str, Any]:
    """What `--set` passes to `gymnasium.make`: JSON where it reads as such, else text; UserError for no name=value."""
    values: dict[str, Any] = {}
    for text in changes:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier() or name in values:
            raise UserError(f"--set '{text}': write name=value, each name once")
        values[name] = value
        with contextlib.suppress(ValueError):
            values[name] = json.loads(value)
    return values


def described(env: Env, real: str, changes: Sequence[str]) -> Gap:
    """The gap, changed; of a robot or environment nobody knows what differs, so that it is a name alone."""
    if not is_stepped(real):
        return gaps.load(env, real, changes)
    return Gap(REMOTE if is_robot(real) else "+".join([real, *changes]), {}, {})


def advice(failed: int, count: int, real: str, **chosen: Any) -> str:
    """Which method suits a policy that has failed so often (docs/diagnose.md), as a command. chosen: its options."""
    more, seeds = "" if count >= ENOUGH else f", {ENOUGH} say more", 1 if is_robot(real) else None
    method = "guarded" if 10 * failed >= 3 * count else "sac"
    command = options.command("finetune", **chosen, real=real, seeds=seeds, method=method)
    return cli.as_typed(f"{failed} of {count} failed{more}: next: {command}")


def connect(
    env: Env, reals: Sequence[str], changes: Sequence[str], *, members: int, gamma: float, home: Path
) -> Gymnasium:
    """The robot, or so many environments of each name, all of the first one first.

    home: where the robot's token is. Raises UserError where an environment cannot be made, or one robot is not enough.
    """
    from sgft_jax.systems.gymnasium import Gymnasium

    cli.in_order("the robot" if is_robot(reals[0]) else "the environments")  # which may be robots too
    if is_robot(reals[0]):
        from sgft_jax.systems.remote import Remote

        if members > 1:
            raise UserError(f"--real {reals[0]}: one robot plays for {members}; choose one policy, or --seeds 1")
        host, port = address(reals[0])
        door: dict[str, Any] = {"host": host, "port": port, "token": token(home), "token_in": str(home / _TOKEN)}
        times = {"period": env.control_dt, "steps": env.episode_length, "waits": lambda: amid("waiting for a robot")}
        return Gymnasium(env, Remote(env.measured_dim, env.act_dim, **times, **door), gamma=gamma)
    import gymnasium

    make = functools.partial(gymnasium.make, **keywords(changes))
    return Gymnasium(env, [_explained(real, make) for real in reals for _ in range(members)], gamma=gamma)


def _registered(name: str) -> None:
    """Raises where Gymnasium knows no environment of that name. Imports the module that registers it."""
    import gymnasium

    module, _, name = name.rpartition(":")
    if module:
        importlib.import_module(module)
    gymnasium.spec(name)


def _explained[T](real: str, ask: Callable[[str], T]) -> T:
    """What is made of an environment's name; raises UserError where there is none, or it fails."""
    import gymnasium

    try:
        return extend.guard("--real", real, ask)(real.removeprefix(GYMNASIUM))
    except UserError as error:
        if isinstance(error.__cause__, gymnasium.error.Error):  # no such name: where that was found out says nothing
            raise UserError(f"--real {real}: {str(error.__cause__).splitlines()[0]}") from error
        raise
