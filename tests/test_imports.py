"""Who imports whom, and what a command imports before it has read its command line: neither JAX nor MuJoCo."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ("jax", "flax", "mujoco", "matplotlib", "scipy", "orbax")
COMMANDS = (
    "pretrain",
    "finetune",
    "evaluate",
    "demo",
    "figures",
    "compare",
    "compare_hybrid",
    "gaps",
    "studies.tune",
    "studies.gaps_draw",
    "studies.diagnose_calibrate",
    "benchmark",
    "tasks",
    "diagnose",
    "export",
    "export_data",
    "replay",
    "hybrid",
)
MISTAKES = {
    "pretrain": "--config.gamma 2",
    "finetune": "--method sgft-sca",
    "evaluate": "--task hamer",
    "demo": "--seeds 0",
    "compare": "--methods sac sac",
    "compare_hybrid": "--methods sac foo --reference sac",
    "gaps": "--episodes 3",
    "studies.tune": "--tasks hamer",
    "studies.gaps_draw": "--count 0",
    "benchmark": "--worlds 0",
    "diagnose": "--rollouts 0",
    "export": "--policy nowhere --to onnx",
    "export_data": "--run nowhere --to minari",
    "replay": "--run nowhere",
    "hybrid": "--gap sim --task halfcheetah",
}
LIGHT = ("sgft_jax", "sgft_jax.checks", "sgft_jax.models.config", "experiments.runner.cli", "sgft_jax.presets")

ROOT = Path(__file__).parents[1]
NEVER = {  # files by glob: what none of them imports, not inside functions either
    "envs/**/*.py": ("experiments",),
    "sgft_jax/**/*.py": ("experiments",),
    "experiments/*.py": ("experiments.studies",),
    "experiments/bench/*.py": ("experiments.studies",),
    "experiments/runner/*.py": ("experiments.studies",),
}


def imports(path):
    """The modules and names that a file imports anywhere, each as a dotted name."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("files", NEVER)
def test_imports_point_one_way(files):
    paths = sorted(ROOT.glob(files))
    assert paths
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in paths
        for name in imports(path)
        if any(f"{name}.".startswith(f"{package}.") for package in NEVER[files])
    ]
    assert wrong == []


def imported(program):
    """The heavy ones among the modules that a fresh interpreter has imported after `program`."""
    code = f"import sys\n{program}\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1].split()


@pytest.mark.parametrize("module", LIGHT)
def test_modules_that_define_options_are_light(module):
    assert imported(f"import {module}") == []


def ends(command, *argv, code):
    """What a command imports until it ends with that exit code."""
    return imported(
        f"import runpy; sys.argv = {['x', *argv]}\n"
        f"try: runpy.run_module('experiments.{command}', run_name='__main__')\n"
        f"except SystemExit as stopped: assert (stopped.code or 0) == {code}"
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_help_starts_neither_jax_nor_mujoco(command):
    assert ends(command, "--help", code=0) == []


@pytest.mark.parametrize("command", MISTAKES)
def test_mistakes_are_found_without_jax_or_mujoco(command, tmp_path):
    assert ends(command, *MISTAKES[command].split(), "--out", str(tmp_path), code=2) == []
    assert not list(tmp_path.iterdir())


def test_the_list_of_commands_is_light():
    assert imported("from experiments import __main__; __main__.main([])") == []


def test_a_public_name_is_imported_when_it_is_used():
    assert imported("import sgft_jax; sgft_jax.NetworkConfig") == []
    assert "jax" in imported("import sgft_jax; sgft_jax.learners.sac")
