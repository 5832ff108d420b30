"""Digests of short runs on a CPU: what a change that must not move a bit is compared by.

    .venv/bin/python tests/digests.py                       # against tests/digests.json; code 1 if anything differs
    .venv/bin/python tests/digests.py learner/ method/sgft  # the runs whose names begin so
    .venv/bin/python tests/digests.py --write               # makes the file anew

The bits depend on the versions of JAX and on the CPU, which the file names. Elsewhere two commits are compared by
digests of both, made on one machine: --write --file PATH on the one, --file PATH on the other.

A digest is of the arrays of a result, whatever their names and their order, so fields may be renamed and moved. It does
not notice two arrays of a result that change places.
"""
# ruff: noqa: E402

import argparse
import functools
import hashlib
import importlib
import itertools
import json
import os
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "tests" / "digests.json"
# This checkout, wherever an editable install points to
sys.path[:0] = [str(ROOT / part) for part in ("tests", "", "tests/sgft_jax", "tests/sgft_jax/train")]
for variable in [name for name in os.environ if name.startswith(("JAX_", "XLA_"))]:
    del os.environ[variable]
os.environ["JAX_PLATFORMS"] = "cpu"

importlib.import_module("conftest")  # XLA's flags, before JAX starts

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np

# Helpers of the tests
import probes
import test_hybrid_training as hybrid_tests
import test_pretraining as pretraining_tests
import toy
import toy_terminating
import tuners

# The project
from envs import gaps
from sgft_jax import api, planning
from sgft_jax.learners import tdmpc2_model
from sgft_jax.train import finetuning, pretraining
from sgft_jax.types import Batch

# --- digests --------------------------------------------------------------------------------------------------------


def digest(tree):
    """Of all arrays of a tree, without their names and their order."""
    return hashlib.sha256("".join(sorted(map(digest_of_array, jax.tree.leaves(tree)))).encode()).hexdigest()[:16]


def digest_of_array(x):
    x = jnp.asarray(x)
    x = np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
    return hashlib.sha256(f"{x.dtype} {x.shape} ".encode() + x.tobytes()).hexdigest()


def dependencies():
    """What the bits depend on beside the code."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
    return {"jax": jax.__version__, "jaxlib": jaxlib.__version__, "cpu": cpu}


def copy_of(tree):
    """A yielded state is donated to the next step."""
    return jax.tree.map(jnp.copy, tree)


# --- runs: each returns what is digested ----------------------------------------------------------------------------


def random_batch(case, key):
    """[probes.ROWS] random rows, or windows of two of them, as the learner of a case wants it."""

    def rows(key):
        key_obs, key_action, key_reward, key_step = jax.random.split(key, 4)
        obs = jax.random.normal(key_obs, (probes.ROWS, 2))
        action = jax.random.uniform(key_action, (probes.ROWS, 1), minval=-1)
        reward = jax.random.normal(key_reward, (probes.ROWS,))
        step = jax.random.normal(key_step, obs.shape)
        return Batch(obs, action, reward, jnp.where(reward > 1, 0.0, 0.9), obs + 0.1 * step)

    first, second = rows(key), rows(jax.random.fold_in(key, 1))
    if case.feed is not probes.windows:
        return case.feed(first)
    both = jax.tree.map(lambda *x: jnp.stack(x, axis=1), first, second._replace(obs=first.next_obs))
    return both._replace(valid=jnp.stack([jnp.ones(probes.ROWS, bool), jnp.arange(probes.ROWS) % 4 > 0], axis=1))


def learner(name):
    """Two updates of a learner by itself."""
    case = probes.case(name)
    state, batch = case.start(jax.random.key(0)), random_batch(case, jax.random.key(1))
    for seed in (2, 3):
        state, _ = case.learner.update(state, batch, jax.random.key(seed))
    return state


def method(name):
    """A method of fine-tuning: two phases of updates around an episode."""
    case = tuners.tuner(name)
    state, _ = case.fine.learn(tuners.started(case), jax.random.key(3))
    episode = tuners.episode(jax.random.key(9))
    state = case.fine.observe(state, episode, jnp.ones(tuners.T, bool), jnp.float32(1))
    state, metrics = case.fine.learn(state, jax.random.key(4))
    return case.fine.export(state), metrics


def hybrid(name):
    """A method that learns from fixed data, most of them also from a simulator."""
    *_, (state, _) = hybrid_tests.played(hybrid_tests.build(name))
    return state.learner


OBSERVATIONS = jnp.array([[0.0, 0.0], [0.7, -0.3], [-1.5, 2.0], [4.0, 0.1]])


def played(act, carry):
    """The actions of act(carry, obs, key, explore=...) along the observations, best and exploring."""
    actions = []
    for explore in (False, True):
        now = carry
        for i, obs in enumerate(OBSERVATIONS):
            action, now = act(now, obs, jax.random.key(i), explore=explore)
            actions.append(action)
    return jnp.stack(actions)


def planner_mppi():
    """The search alone, with proposals, on a score with two peaks."""
    config, hyper = planning.MPPIConfig(samples=32, elites=6, iterations=4), planning.MPPIHyper()
    proposals = jax.random.uniform(jax.random.key(1), (4, 3, 2), minval=-1)

    @functools.partial(jax.jit, static_argnames="explore")
    def act(previous, obs, key, *, explore):
        def score(sequence):
            return -jnp.abs(jnp.square(sequence - 0.1 * obs) - 0.25).sum()

        return planning.plan(config, hyper, score, proposals, previous, key, explore=explore)

    return played(act, jnp.zeros((3, 2)))


def planner_mpc():
    """Plans by the models of a SAC prior."""
    config = planning.MPCConfig(2, 2, tuners.NET, horizon=2, samples=32)
    act = planning.make_act(config, reward=tuners.reward, terminated=tuners.TASK.terminated)
    act = functools.partial(jax.jit(act, static_argnames="explore"), tuners.prior("sac").params)
    return played(act, planning.init_carry(config))


def planner_tdmpc2():
    """Plans in the latent space of TD-MPC2 after two updates."""
    planner = probes.case("tdmpc2").learner
    return played(functools.partial(planner.act, learner("tdmpc2")), planner.init_carry())


@mock.patch.dict(tdmpc2_model.SIZES, tiny=tdmpc2_model.Size(8, 8, 8, 2, 2))
def pretrain(algorithm, resume=False):
    """Two seeds, two chunks. resume: the second one by another call, from a copy of the state."""
    config = replace(pretraining_tests.CONFIG, algorithm=algorithm, random_ladder=0.5)
    run = functools.partial(pretraining.pretrain, toy_terminating.make(), config, [3, 4])
    *_, (state, _) = itertools.islice(run(), 2) if resume else run()
    if resume:
        *_, (state, _) = run(state=copy_of(state))
    return state.learner


def resume_hybrid():
    """From the second of four chunks."""
    agent = hybrid_tests.build("h2oplus")
    middle, _ = hybrid_tests.played(agent)[2]
    *_, (state, _) = hybrid_tests.played(agent, state=middle)
    return state.learner


def finetune(resume=False):
    """SAC from nothing on two heavy toys, three rollouts. resume: the third by another call, from a copy."""
    env = toy.make()
    gap = gaps.from_dict(env, "heavy", {"params": {"mass": 1.4}, "effects": {"latency": 0.03}})
    setup = api.setup(env, gap, [], method="sac", seeds=2)
    *_, (progress, metrics) = finetuning.finetune(*setup, rollouts=2 if resume else 3)
    if resume:
        *_, (progress, metrics) = finetuning.finetune(*setup, rollouts=3, progress=copy_of(progress))
    return jax.vmap(setup.finetuner.export)(progress.agent), metrics["real/score"]


def runs(prefix, run, names):
    return {f"{prefix}/{name.replace(', ', '-').replace(' ', '-')}": functools.partial(run, name) for name in names}


RUNS = {
    **runs("learner", learner, probes.MAKERS),
    **runs("method", method, tuners.METHODS),
    **runs("hybrid", hybrid, hybrid_tests.FIXED_NAMES),
    "planner/mppi": planner_mppi,
    "planner/mpc": planner_mpc,
    "planner/tdmpc2": planner_tdmpc2,
    **runs("pretrain", pretrain, ("sac", "tdmpc2", "recurrent")),
    "finetune/sac": finetune,
    "resume/pretrain": functools.partial(pretrain, "sac", resume=True),  # the same digest as uninterrupted
    "resume/hybrid": resume_hybrid,
    "resume/finetune": functools.partial(finetune, resume=True),
}

# --- the command ----------------------------------------------------------------------------------------------------


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("prefixes", nargs="*", metavar="PREFIX", help="of names of runs; none: all runs")
    parser.add_argument("--write", action="store_true", help="renew the file")
    parser.add_argument("--file", type=Path, default=FILE, help="of the digests; default: tests/digests.json")
    options = parser.parse_args()

    current = dependencies()
    if options.file.exists():
        record = json.loads(options.file.read_text())
    elif options.write:
        record = {"made with": current, "digests": {}}
    else:
        parser.error(f"there is no {options.file}; --write makes it")
    old = record["digests"]
    names = [name for name in [*RUNS, *sorted(old.keys() - RUNS)] if name.startswith(tuple(options.prefixes) or "")]
    if not names:
        parser.error(f"no run begins with {' or '.join(options.prefixes)}")
    differences = [
        f"{x} is {current[x]}, not {value}" for x, value in record["made with"].items() if current[x] != value
    ]
    if differences and options.write and options.prefixes:
        parser.error(f"{', '.join(differences)}: only the whole file can be renewed")
    if differences and not options.write:
        print(f"{', '.join(differences)}: compare digests of two commits made on one machine (--write --file PATH)")

    start, new = time.monotonic(), {}
    for name in names:
        if name in RUNS:
            new[name] = digest_of_run(RUNS[name])
        verdict = "ok" if name in new and new[name] == old.get(name) else "CHANGED"
        print(f"{name:<30}  {new.get(name, 'gone'):<16}  {verdict}", flush=True)
    changes = sum(new.get(name) != old.get(name) for name in names)
    print(f"{len(names)} runs in {time.monotonic() - start:.0f} s, {changes} changed")
    if not options.write:
        return int(changes > 0)
    if "failed" in new.values():
        print(f"{options.file} stays as it is: a run failed")
        return 1
    digests = {name: (old | new)[name] for name in RUNS if name in old or name in new}
    options.file.write_text(json.dumps({"made with": current, "digests": digests}, indent=2) + "\n")
    return 0


def digest_of_run(run):
    """The digest of its result, or "failed" with the traceback on stderr."""
    try:
        return digest(run())
    except Exception:
        traceback.print_exc()
        return "failed"
    finally:
        jax.clear_caches()  # compiled programs stay mapped into memory, and a process has a limited number of mappings


if __name__ == "__main__":
    sys.exit(main())
