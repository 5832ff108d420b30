"""JAX set to compute otherwise than this project can is refused at once."""

import os
import subprocess
import sys

import jax
import pytest

import envs
from envs import mesh
from envs.types import UserError


def test_float64_is_refused_before_a_task_is_made():
    with jax.enable_x64(True), pytest.raises(UserError, match="JAX_ENABLE_X64 is on"):
        envs.make("push")


@pytest.mark.heavy
@pytest.mark.parametrize("platform", ["rocm", "nonsense"])  # no machine of ours has devices of that maker
def test_so_is_a_platform_that_is_not_there(platform):
    program = "from envs import mesh, types\ntry: mesh.check_jax()\nexcept types.UserError as error: print(error)\n"
    environment = {**os.environ, "JAX_PLATFORMS": platform}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stdout.startswith(f"JAX_PLATFORMS={platform}: ") and done.stdout.count("\n") == 1
    assert done.stdout.endswith("; unset it, or set it to cpu\n") and done.returncode == 0


def test_what_is_usual_is_not():
    mesh.check_jax()
