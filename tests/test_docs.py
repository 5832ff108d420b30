"""What README.md and docs/ tell people to type exists: targets, modules, options, files, headings; the site builds."""

import ast
import contextlib
import functools
import importlib
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import pytest

import envs
from envs import gaps
from sgft_jax.methods import all_methods

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()
DOCS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = "".join(re.findall(r"^```bash\n(.*?)^```$", README, re.M | re.S))
TYPED = [*SHELL.splitlines(), *re.findall(r"`([^`\n]+)`", README)]
COMMANDS = [shlex.split(line, comments=True) for line in TYPED if line.startswith(("make ", "python "))]
MODULES = sorted(set(re.findall(r"-m (experiments[.\w]*\w)", MAKEFILE + "".join(path.read_text() for path in DOCS))))


@functools.cache
def help_of(module: str) -> str:
    """What `python -m module --help` prints; the command must end with code 0."""
    text, argv = io.StringIO(), sys.argv
    try:
        sys.argv = [module, "--help"]
        with contextlib.redirect_stdout(text), warnings.catch_warnings(), pytest.raises(SystemExit) as stopped:
            warnings.simplefilter("ignore", RuntimeWarning)  # the module may have been imported by another test
            runpy.run_module(module, run_name="__main__")
    finally:
        sys.argv = argv
    assert stopped.value.code in (None, 0)
    return text.getvalue()


def test_the_readme_has_commands():
    assert ["make", "setup"] in COMMANDS and ["make", "demo"] in COMMANDS and len(MODULES) >= 6


def test_the_documentation_is_short():
    assert len(README.split()) <= 700
    pages = [path.read_text() for path in (ROOT / "docs").rglob("*.md")]
    assert len(" ".join(pages).split()) <= 24_000


@pytest.mark.parametrize("words", [c for c in COMMANDS if c[0] == "make"], ids=" ".join)
def test_make_targets_and_variables_exist(words):
    targets = [word for word in words[1:] if "=" not in word]
    assert targets and all(re.search(rf"^{target}:.* ## ", MAKEFILE, re.M) for target in targets)
    for variable in (word.partition("=")[0] for word in words[1:] if "=" in word):
        assert re.search(rf"\$[({{](call [\w-]+,)?{variable}\b", MAKEFILE), variable


@pytest.mark.parametrize("module", MODULES)
def test_every_command_has_help(module):
    """Of all commands that the documentation or the Makefile names."""
    assert "--help" in help_of(module)


@pytest.mark.parametrize("words", [c for c in COMMANDS if c[0] == "python"], ids=" ".join)
def test_options_exist(words):
    assert words[1] == "-m"
    listed = set(re.findall(r"--[\w.-]+", help_of(words[2])))
    assert {word for word in words if word.startswith("--")} <= listed


def test_make_flags_are_options_of_the_commands():
    """`make finetune TASK=...` passes --task: each variable that the list of targets names must be an option there."""
    for target, names in re.findall(r"^(\w+): \$\(PY\) ## ((?:[A-Z]+, )*[A-Z]+):", MAKEFILE, re.M):
        for name in names.split(", "):
            assert f"--{name.lower()}" in help_of(f"experiments.{target}"), (target, name)


def links(page):
    """(target, anchor) of the links in a page to files of ours; one to a heading of the page itself has no target."""
    return re.findall(r"\]\((?!https://)([^)#]*)#?([^)]*)\)", page.read_text())


def imported(page):
    """(module, name) of what programs on a page import from packages of ours, or take from these by a dot."""
    for program in re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.M | re.S):
        for node in ast.walk(ast.parse(program)):
            if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] in ("envs", "sgft_jax"):
                yield from ((node.module, alias.name) for alias in node.names)
            if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") in ("envs", "sgft_jax"):
                yield node.value.id, node.attr


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_programs_use_names_that_exist(page):
    for module, name in imported(page):
        try:
            importlib.import_module(f"{module}.{name}")
        except ImportError:
            assert hasattr(importlib.import_module(module), name), (module, name)


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_links_lead_to_files(page):
    for target, _ in links(page):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", DOCS, ids=lambda path: path.name)
def test_links_lead_to_headings(page):
    """As GitHub names them: lower case, hyphens for spaces, without other signs."""
    for target, anchor in links(page):
        if anchor:
            headings = re.findall(r"^#+ (.*)$", (page.parent / target if target else page).read_text(), re.M)
            assert anchor in {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings}, (target, anchor)


def test_the_page_of_methods_lists_them_all_and_so_does_the_help():
    """With the family and the kind of prior that each declares, in the order of the package."""
    page, kinds = (ROOT / "docs/methods.md").read_text(), {"sac": "SAC", "tdmpc2": "TD-MPC2", "recurrent": "recurrent"}
    rows = re.findall(r"^\| `([\w-]+)` \| ([\w-]+) \|[^|]*\| ([\w-]+)[^|]*\|[^|]*\|$", page, re.M)
    assert rows == [(name, method.family, kinds[method.prior]) for name, method in all_methods().items()]
    shown = help_of("experiments.finetune")
    assert all(re.search(rf"(?<![\w-]){name}(?![\w-])", shown) for name, *_ in rows)


def section_of(task):
    """The part of the page of tasks that is about one of them."""
    return re.search(rf"^## {task}$(.*?)^## ", (ROOT / "docs/tasks.md").read_text(), re.M | re.S)[1]


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("task", envs.TASKS)
def test_the_page_of_tasks_names_their_entries_parameters_and_gaps(task):
    """What a section leaves out is in that of the task that it refers to."""
    section = section_of(task)
    whole = "".join(
        [section, *(section_of(other) for other in re.findall(r"\bas ([\w-]+)", section) if other in envs.TASKS)]
    )
    env = envs.make(task)
    for entry in (*env.observation, *env.action, *env.parameters):
        assert f"`{entry.name}`" in whole, entry.name
    row = re.search(r"^\| gaps \| (.*) \|$", whole, re.M)[1]
    assert set(gaps.presets(env.name)) == set(re.findall(r"`([\w-]+)`", row))


def test_the_page_of_tasks_names_the_effects():
    effects = (ROOT / "docs/tasks.md").read_text().partition("## Effects")[2]
    assert all(f"`{name}`" in effects for name in envs.Effects._fields)


def test_the_gap_on_the_page_about_extending_loads(tmp_path):
    (shown,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs/extending.md").read_text(), re.S)
    (tmp_path / "my_gap.toml").write_text(shown)
    gap = gaps.load(envs.make("push"), str(tmp_path / "my_gap.toml"), ["latency=0.08", "action_scale=[1.2,0.9]"])
    written = tomllib.loads(shown)
    assert gap.params == written["params"]
    assert gap.effects == {**written["effects"], "latency": 0.08, "action_scale": [1.2, 0.9]}


@pytest.mark.slow  # `make docs` does the same
def test_the_site_builds_without_a_warning(tmp_path):
    """Dead links, dead anchors and pages that nobody can reach end the build."""
    pytest.importorskip("material", reason="make setup EXTRAS=dev,docs")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    html = (tmp_path / "api.html").read_text()
    assert "sgft_jax.learners.sac.make_sac" in html
    assert not re.search(r'(src|rel="stylesheet" href)="(https?:)?//', html), (
        "the page loads something from the network"
    )
