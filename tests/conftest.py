"""CPU, MJX, two host devices, strict promotion: set before JAX starts."""

import gc
import importlib
import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MUJOCO_GL", "disable")
os.environ["SGFT_IMPL"] = "jax"  # MJX's own code; tests/envs/test_engines.py is about the others
# Compiling is most of what the tests do; what they compile runs for moments.
os.environ["XLA_FLAGS"] = " ".join(
    [
        os.environ.get("XLA_FLAGS", ""),
        "--xla_force_host_platform_device_count=2",
        "--xla_backend_optimization_level=0",
        "--xla_llvm_disable_expensive_passes=true",
        "--xla_cpu_parallel_codegen_split_count=1",  # a fifth faster where every core has a worker
        # These passes only make programs faster. Without them a big program compiles in a fifth less time.
        "--xla_disable_hlo_passes=simplify-while-loops,while-loop-invariant-code-motion,while-loop-constant-sinking,"
        "reshape-mover,tree_reduction_rewriter,simplify-conditional",
    ]
)

import jax
import pytest

from experiments.runner import progress

# Tracing makes many objects that live on: dead ones are looked for less often than Python does by itself.
gc.freeze()
gc.set_threshold(50_000, 20, 20)

_FOREIGN = {"stable_baselines3", "torch"}  # none of our extras brings them; all others are installed by .ci/run
_importorskip = pytest.importorskip


if os.environ.get("CI"):  # what is missing there was forgotten, and its tests would never run again
    pytest.importorskip = lambda name, *_, **more: (
        _importorskip(name, **more) if name in _FOREIGN else importlib.import_module(name)
    )

jax.config.update("jax_compilation_cache_dir", os.path.join(os.path.dirname(__file__), "..", ".cache", "jax"))
# Even an addition takes 25 ms to compile, and 2 ms to read. Both workers read them, also after `_few_programs`.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Of a test marked `heavy_after_first`, `make test` runs the first case alone."""
    begun = set()
    for item in items:
        if item.get_closest_marker("heavy_after_first"):
            test = item.nodeid.partition("[")[0]
            if test in begun:
                item.add_marker(pytest.mark.heavy)
            begun.add(test)


@pytest.fixture(autouse=True)
def _patient(monkeypatch, request):
    """Commands announce what they do; lines that say how long it lasts would depend on how busy the machine is."""
    for limit in ("_FIRST", "_AGAIN", "_SELDOM"):
        monkeypatch.setattr(progress, limit, float("inf"))


@pytest.fixture(autouse=True)
def _strict_ranks():
    """Broadcasting [B] against [B, 1] is the classic silent bug of reinforcement learning."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(autouse=True, scope="module")
def _few_programs():
    """Compiled programs stay mapped into memory. Linux allows a process 65,530 mappings; beyond them XLA crashes."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()


@pytest.fixture
def key():
    return jax.random.key(0)
