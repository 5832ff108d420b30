"""Who imports whom, and what a command imports before it has read its command line: neither JAX nor MuJoCo."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

HEAVY = ("jax", "flax", "mujoco", "matplotlib", "scipy", "orbax", "rich")
COMMANDS = (
    "pretrain",
    "finetune",
    "evaluate",
    "demo",
    "figures",
    "compare",
    "compare hybrid",
    "gaps",
    "studies.tune",
    "studies.gaps_draw",
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
    "demo": "--rollouts 0",
    "compare": "--methods sac sac",
    "compare hybrid": "--methods sac foo --reference sac",
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
# The rooms of a package, a file or a folder each, lowest first: a room imports only rooms before it. "" is the package.
ORDER = {
    "envs": (
        *(
            "types",
            "files",
            "extend",
            "mesh",
            "base",
            "effects",
            "commands",
            "domains",
            "patches",
            "observations",
            "doraemon",
            "rewards",
            "gaps",
        ),
        *("gap_distribution", "checks", "mujoco", "control", "franka", "locomotion", "", "rollout", "adapters"),
    ),
    "sgft_jax": (
        *("types", "theory", "keys", "checks", "stacking", "files", "math", "models", "posterior", "data", "planning"),
        *("learners", "policies", "diagnosis", "transforms", "algorithms", "presets", "io", "export"),
        *("datasets", "systems", "train"),
        *("methods", "analysis", "api", ""),
    ),
    "experiments": ("runner", "commands", "studies"),  # `bench` is a part of a command
}


@functools.cache
def imports():
    """{module: those of ours that it imports}, inside functions too; without what only type checkers read."""
    paths = [path for package in ORDER for path in sorted((ROOT / package).rglob("*.py"))]
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}

    def imported(tree):
        for node in ast.iter_child_nodes(tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, "imports are absolute"
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                yield from (name if name in names else node.module for name in inner)
            elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
                yield from imported(node)

    return {
        name: {other for other in imported(ast.parse(path.read_text())) if other in names and other != name}
        for name, path in names.items()
    }


def place(module):
    """Of a module: the number of its package, then that of its room; commands are one room."""
    package, room, *_ = f"{module}.".split(".")
    if package == "experiments" and room not in ORDER[package]:
        room = "commands"
    return list(ORDER).index(package), ORDER[package].index(room)


def test_folders_and_packages_import_downward():
    pairs = [(module, other) for module, others in imports().items() for other in others]
    assert len(pairs) > 1000
    assert [pair for pair in pairs if place(pair[0]) < place(pair[1])] == []


def test_no_files_import_each_other_in_a_ring():
    done, rings = set(), []

    def visit(module, path):
        if module in path:
            rings.append(frozenset(path[path.index(module) :]))
        elif module not in done:
            for other in sorted(imports()[module]):
                visit(other, [*path, module])
            done.add(module)

    for module in imports():
        visit(module, [])
    assert [sorted(ring) for ring in rings] == []


def imported(*programs):
    """Of each program the heavy ones among the modules that it imports, in a process of its own.

    All are forks of one interpreter that has imported what every command line imports, which is light itself.
    """
    code = f"""
import os, sys
import experiments.runner.cli
for program in sys.argv[1:]:
    sys.stdout.flush()
    child = os.fork()
    if not child:
        said, sys.stdout, ok = sys.stdout, open(os.devnull, "w"), 1
        try:
            exec(program, {{}})
            print(*[name for name in {HEAVY} if name in sys.modules], file=said, flush=True)
            ok = 0
        finally:
            os._exit(ok)
    if os.waitpid(child, 0)[1]:
        sys.exit(f"failed: {{program}}")
"""
    done = subprocess.run([sys.executable, "-c", code, *programs], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [line.split() for line in done.stdout.splitlines()]


def test_modules_that_define_options_are_light():
    heavy = imported(*(f"import {module}" for module in LIGHT))
    assert dict(zip(LIGHT, heavy, strict=True)) == {module: [] for module in LIGHT}


def ending(command, *argv, code):
    """A program that is a command until it ends with that exit code. command: with its subcommand if it has one."""
    module, *more = command.split()
    return (
        f"import runpy, sys; sys.argv = {['x', *more, *argv]}\n"
        f"try: runpy.run_module('experiments.{module}', run_name='__main__')\n"
        f"except SystemExit as stopped: assert (stopped.code or 0) == {code}, stopped.code\n"
        "else: raise AssertionError('it went on')"
    )


def test_help_starts_neither_jax_nor_mujoco():
    heavy = imported(*(ending(command, "--help", code=0) for command in COMMANDS))
    assert dict(zip(COMMANDS, heavy, strict=True)) == {command: [] for command in COMMANDS}


def test_mistakes_are_found_without_jax_or_mujoco(tmp_path):
    programs = [ending(command, *words.split(), "--out", str(tmp_path), code=2) for command, words in MISTAKES.items()]
    assert dict(zip(MISTAKES, imported(*programs), strict=True)) == {command: [] for command in MISTAKES}
    assert not list(tmp_path.iterdir())


def test_the_list_of_commands_is_light():
    assert imported("from experiments import __main__; __main__.main([])") == [[]]


def test_a_public_name_is_imported_when_it_is_used():
    """What is light needs no JAX; a learner is looked for when it is named, and misses it."""
    light = "import sgft_jax; sgft_jax.NetworkConfig"
    learner = (
        f"import sys; sys.modules['jax'] = None; {light}\n"
        "try: sgft_jax.learners.sac\n"
        "except ImportError: del sys.modules['jax']\n"
        "else: raise AssertionError('JAX was not wanted')"
    )
    assert imported(light, learner) == [[], []]
