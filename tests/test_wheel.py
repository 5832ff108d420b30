"""The wheel in an environment of its own, which sees our dependencies and nothing of the checkout."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("envs", "sgft_jax", "experiments")
FINETUNE = """finetune --task push --prior shipped:push --method sac --real default --seeds 1 --rollouts 2 --no-video
    --eval-every 2 --eval-episodes 2 --options.utd 0.02 --options.batch-size 16 --out runs"""

pytestmark = pytest.mark.slow  # .ci/run runs all but the last


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy: what earlier builds have left in the checkout does not come along."""
    source, to = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", to, source]
    if uv := shutil.which("uv"):
        build = [uv, "build", "--quiet", "--wheel", "--out-dir", to, source]
    subprocess.run(build, check=True)
    (path,) = to.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder of programs of an environment with the wheel."""
    home = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", home], check=True)
    python = home / "bin/python"
    words = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", wheel]
    subprocess.run(words, check=True)
    (site,) = home.glob("lib/python*/site-packages")
    # A path that is named in a .pth file is searched, but its own .pth files, one of which names the checkout, are not.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin"


def call(installed, tmp_path, program, *words):
    """What a program of the environment prints."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    cache = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache/jax"), "JAX_PLATFORMS": "cpu"}
    line = [installed / program, *words]
    done = subprocess.run(line, cwd=tmp_path, env={**kept, **cache}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_the_packages_without_studies(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tracked = subprocess.run(["git", "ls-files", *PACKAGES], cwd=ROOT, check=True, capture_output=True, text=True)
    expected = {name for name in tracked.stdout.split() if not name.startswith("experiments/studies/")}
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert {f"{package}/py.typed" for package in PACKAGES} <= expected
    assert wheel.stat().st_size < 14e6  # three estimators are half of it


def test_every_module_can_be_imported(installed, tmp_path):
    program = f"""
import importlib, pkgutil
for package in {PACKAGES}:
    module = importlib.import_module(package)
    assert "site-packages" in module.__file__, module.__file__
    for info in pkgutil.walk_packages(module.__path__, package + "."):
        if not info.name.endswith("__main__"):
            importlib.import_module(info.name)
"""
    call(installed, tmp_path, "python", "-W", "ignore", "-c", program)


def test_commands_show_their_options(installed, tmp_path):
    listed = call(installed, tmp_path, "sgft", "--help")
    names = [line.split()[0] for line in listed.splitlines()[2:]]
    assert {"pretrain", "finetune", "tasks"} <= set(names)
    for name in names:
        assert f"usage: sgft {name} " in call(installed, tmp_path, "sgft", name, "--help").splitlines()[0]


def test_a_shipped_prior_is_fine_tuned_outside_of_the_checkout(installed, tmp_path):
    call(installed, tmp_path, "sgft", *FINETUNE.split())
    (summary,) = (tmp_path / "runs").rglob("summary.json")
    assert json.loads(summary.read_text())
    assert (
        "shipped prior: there is no 'psh', did you mean 'push'?"
        in subprocess.run(
            [installed / "sgft", "evaluate", "--prior", "shipped:psh"], cwd=tmp_path, capture_output=True, text=True
        ).stderr
    )
