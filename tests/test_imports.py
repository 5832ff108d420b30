"""What a command imports before it has read its command line: neither JAX nor MuJoCo, nor what draws."""

import subprocess
import sys

import pytest

HEAVY = ("jax", "flax", "mujoco", "matplotlib", "scipy", "orbax")
LIGHT = ("sgft_jax", "sgft_jax.checks", "sgft_jax.models.config", "experiments.cli", "sgft_jax.presets")


def imported(program):
    """The heavy ones among the modules that a fresh interpreter has imported after `program`."""
    code = f"import sys\n{program}\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1].split()


@pytest.mark.parametrize("module", LIGHT)
def test_modules_that_define_options_are_light(module):
    assert imported(f"import {module}") == []


def test_a_public_name_is_imported_when_it_is_used():
    assert imported("import sgft_jax; sgft_jax.NetworkConfig") == []
    assert "jax" in imported("import sgft_jax; sgft_jax.make_sac")
