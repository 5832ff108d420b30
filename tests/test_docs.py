"""What README.md tells people to type exists: targets, modules, options, files, and the gap it shows."""

import contextlib
import functools
import io
import re
import runpy
import shlex
import sys
import tomllib
import warnings
from pathlib import Path

import pytest

import envs
from envs import gaps
from sgft_jax.methods import METHODS, default_settings

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()
DOCS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = [shlex.split(line, comments=True) for line in re.findall(r"^    ((?:make|python) .*)$", README, re.M)]
MODULES = sorted(set(re.findall(r"-m (experiments\.\w+)", MAKEFILE + "".join(path.read_text() for path in DOCS))))


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
    page = (ROOT / "docs/methods.md").read_text()
    rows = re.findall(r"^\| `([\w-]+)` \|[^|]*\|([^|]*)\|([^|]*)\|[^|]*\|$", page, re.M)
    known = {name: (", ".join(m.parts), m.needs) for name, m in METHODS.items()}
    assert {name: (transforms.strip(), needs.strip()) for name, transforms, needs in rows} == known
    shown = help_of("experiments.finetune")
    for name, (transforms, needs) in known.items():
        about = f"batches: {transforms}; prior: {needs}" if transforms else f"prior: {needs}"
        assert re.search(rf"^  {name} .*\n +{re.escape(about)}$", shown, re.M), name


def test_the_page_of_methods_shows_what_tuning_chooses_from():
    """Each line as it follows from the table of methods, defaults in bold."""

    def line(method):
        default = default_settings(method)
        shown = {name: [_shown(value, value == default[name]) for value in each] for name, each in method.space.items()}
        return "; ".join(f"`{name}` {', '.join(each)}" for name, each in shown.items())

    rows = re.findall(r"^\| ([\w, -]+) \| (`utd` .*) \|$", (ROOT / "docs/methods.md").read_text(), re.M)
    assert {name: text for names, text in rows for name in names.split(", ")} == {
        method.name: line(method) for method in METHODS.values()
    }


def _shown(value, default):
    text = "None" if value is None else f"{value:g}"
    return f"**{text}**" if default else text


def test_the_gap_in_the_readme_loads(tmp_path, key):
    (shown,) = re.findall(r"```toml\n(.*?)```", README, re.S)
    (tmp_path / "my_table.toml").write_text(shown)
    env = envs.make("push")
    gap = gaps.load(env, str(tmp_path / "my_table.toml"), ["latency=0.08", "action_scale=[1.2,0.9]"])
    worlds = gaps.worlds(env, gap, key, n=2)
    assert gap.params == tomllib.loads(shown)["params"]
    assert worlds.theta.effects.high.action_scale[0].tolist() == pytest.approx([1.2, 0.9])
