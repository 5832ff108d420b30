"""Which random keys a program uses, read off its equations: nothing is compiled but what makes keys of keys."""

import collections
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

Uses = collections.Counter[bytes]
Late = Callable[[], Any]  # a value that is computed when something asks for it


def used_twice(function: Callable[..., Any], *args: Any) -> int:
    """How many keys `function(key, *args)` uses more than once; draws and splits use a key up.

    args: arrays or their shapes; no key is in them. Keys are told apart by their bits. JAX's own check
    (`jax.debug_key_reuse`) takes keys that were split outside of a vmapped loop for the same one.
    """
    key = jax.random.key(3)
    program = jax.make_jaxpr(function)(key, *args)
    uses: Uses = collections.Counter()
    _run(program, [lambda: key] + [_unknown] * (len(program.jaxpr.invars) - 1), uses)
    assert uses, "no key was used at all"
    return sum(n > 1 for n in uses.values())


def _unknown() -> Any:
    raise LookupError("a key that depends on data")


def _run(program: Any, args: Sequence[Late], uses: Uses) -> list[Late]:
    """Counts the keys that a program uses up; its results."""
    jaxpr = getattr(program, "jaxpr", program)
    known = dict(zip(jaxpr.invars, args, strict=True))
    known |= {var: (lambda x=x: x) for var, x in zip(jaxpr.constvars, getattr(program, "consts", ()), strict=True)}

    def value(var: Any) -> Late:
        return (lambda: var.val) if isinstance(var, core.Literal) else known[var]

    for eqn in jaxpr.eqns:
        known |= zip(eqn.outvars, _results(eqn, [value(var) for var in eqn.invars], uses), strict=True)
    return [value(var) for var in jaxpr.outvars]


def _results(eqn: Any, args: list[Late], uses: Uses) -> Sequence[Late]:
    name, params = eqn.primitive.name, eqn.params
    if name == "scan":
        return _scan(eqn, args, uses)
    if name == "cond":
        return _cond(params["branches"], args, uses)
    if name == "while":  # a round of it
        n = params["cond_nconsts"]
        return _run(params["body_jaxpr"], args[n:], uses)
    if inner := next((params[x] for x in ("jaxpr", "call_jaxpr") if x in params), None):
        return _run(inner, args, uses)
    if name in ("random_bits", "random_split"):
        data = np.asarray(jax.random.key_data(args[0]()))
        uses.update(one.tobytes() for one in data.reshape(-1, data.shape[-1]))
    several = eqn.primitive.multiple_results

    @functools.cache
    def results() -> Any:
        out = eqn.primitive.bind(*[arg() for arg in args], **params)
        return out if several else [out]

    return [lambda i=i: results()[i] for i in range(len(eqn.outvars))]


def _scan(eqn: Any, args: list[Late], uses: Uses) -> list[Late]:
    body, length, backwards = eqn.params["jaxpr"], eqn.params["length"], eqn.params["reverse"]

    def shorter(whole: Sequence[Any], one: Sequence[Any]) -> int:
        return sum(a.aval.shape != b.aval.shape for a, b in zip(whole, one, strict=True))

    rows_out, rows_in = shorter(eqn.outvars, body.jaxpr.outvars), shorter(eqn.invars, body.jaxpr.invars)
    m = len(eqn.outvars) - rows_out
    n = len(args) - rows_in - m
    fixed, carry, rows, steps = args[:n], args[n : n + m], args[n + m :], []
    for i in range(length)[:: -1 if backwards else 1]:
        after = _run(body, [*fixed, *carry, *(lambda x=x, i=i: x()[i] for x in rows)], uses)
        carry = after[:m]
        steps.append(after[m:])
    columns = zip(*steps[:: -1 if backwards else 1], strict=True)
    return [*carry, *(lambda x=x: jnp.stack([one() for one in x]) for x in columns)]


def _cond(branches: Sequence[Any], args: list[Late], uses: Uses) -> list[Late]:
    """Either branch may run, but only one does."""
    counts: list[Uses] = [collections.Counter() for _ in branches]
    results = [_run(branch, args[1:], count) for branch, count in zip(branches, counts, strict=True)]
    uses.update(functools.reduce(lambda a, b: a | b, counts))
    return results[0]
