"""Programs that compile in threads before they are called."""

import contextlib

import jax
import jax.numpy as jnp

from experiments.runner.ahead import compiling


def test_a_call_waits_for_what_was_promised_of_its_program():
    program, waited = jax.jit(lambda x: 2 * x), []

    with compiling() as ahead:
        for n in (2, 3):
            ahead.promise(program, lambda n=n: (jax.ShapeDtypeStruct((n,), jnp.float32),))
        call = ahead.awaited(program, lambda: contextlib.nullcontext(waited.append(True)))
        assert [call(jnp.ones(n)).tolist() for n in (2, 3)] == [[2.0] * 2, [2.0] * 3]
    assert len(waited) <= 1


def test_what_fails_in_a_thread_fails_where_it_is_called():
    """And what never began, because the block was left, is no failure."""
    program = jax.jit(lambda x: x + 1)
    with compiling() as ahead:
        ahead.promise(program, lambda: 1 / 0)
        assert ahead.awaited(program, contextlib.nullcontext)(jnp.float32(1)) == 2
        for _ in range(50):
            ahead.promise(program, lambda: (jnp.float32(1),))
    ahead.wait(program)
    assert ahead.done(program)
