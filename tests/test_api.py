"""Every public name is there, once, and explains itself; docs/api.md gets its list of them from the same function."""

import ast
import importlib.util
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import pytest

import envs
import sgft_jax

HOOK = Path(__file__).parent.parent / ".ci/docs_names.py"


def load_hook():
    spec = importlib.util.spec_from_file_location("docs_names", HOOK)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


names = load_hook()
PUBLIC = [(f"{package}.{name}", thing) for package in names.PACKAGES for name, thing in names.public(package)]


def public_modules():
    """The modules that public names are of, with these names."""
    modules = {}
    for full, thing in PUBLIC:
        if isinstance(thing, ModuleType) and not hasattr(thing, "__path__"):
            listed = (name.removeprefix(f"{full}.") for name, _ in PUBLIC if name.startswith(f"{full}."))
            modules.setdefault(thing.__name__, set()).update(listed)
    for node in ast.parse(Path(sgft_jax.__file__).with_suffix(".pyi").read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            names = {alias.name for alias in node.names}
            things = {name for name in names if not isinstance(getattr(sgft_jax, name), ModuleType)}
            if things:
                modules.setdefault(f"sgft_jax.{node.module}", set()).update(things)
    return modules


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(("name", "thing"), PUBLIC, ids=[name for name, _ in PUBLIC])
def test_public_names_explain_themselves(name, thing):
    if inspect.isroutine(thing) or inspect.isclass(thing) or isinstance(thing, ModuleType):
        doc = inspect.getdoc(thing) or ""
        assert len(doc) > 20 and not doc.startswith(f"{name.rpartition('.')[2]}("), "no docstring of its own"


@pytest.mark.parametrize("package", [sgft_jax, envs], ids=lambda package: package.__name__)
def test_public_names_are_listed_once(package):
    assert len(set(package.__all__)) == len(package.__all__)


@pytest.mark.parametrize("module", sorted(public_modules()))
def test_a_public_module_lists_what_is_public(module):
    """Its `__all__` is what the stub of the package takes from it, or for a public module what docs/api.md lists."""
    assert sorted(importlib.import_module(module).__all__) == sorted(public_modules()[module])


def test_the_page_lists_them_with_what_they_are():
    page = names.on_page_markdown((HOOK.parent.parent / "docs/api.md").read_text())
    assert names.MARK not in page
    for name, _ in PUBLIC:
        assert f"\n| `{name}` | " in page


def test_a_name_is_explained_by_its_first_sentence():
    def twice():
        """Returns a | b\n        in one line. Then more.\n\nAnd more."""

    assert names.summary(twice) == "Returns a \\| b in one line"
    assert names.summary({"no": "docstring"}) == "data"


# --- a loop of a user's own -------------------------------------------------------------------------------------------


def loop_example():
    """The program under that heading of the page."""
    section = (HOOK.parent.parent / "docs/api.md").read_text().partition("## A loop of your own")[2]
    return re.search(r"```python\n(.*?)```", section, re.S).group(1)


def test_a_users_own_loop_calls_the_library_as_it_is():
    """Its functions traced, not compiled: states and losses have the shapes that the page shows."""
    scope = {}
    exec(compile(loop_example().partition("\nrng, ")[0], "docs/api.md", "exec"), scope)
    seeds, updates, rows = (scope[name] for name in ("SEEDS", "UPDATES", "ROWS"))
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), (updates, seeds)))
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), keys)
    states = jax.eval_shape(jax.vmap(lambda key: scope["sac"].init(scope["config"], key)), one)
    action, _ = jax.eval_shape(scope["act"], states, (), jax.ShapeDtypeStruct((seeds, 2), "float32"), one)
    shapes = {"obs": (2,), "action": (2,), "reward": (), "discount": (), "next_obs": (2,)}
    rows_of = {name: jax.ShapeDtypeStruct((updates, seeds, rows, *shape), "float32") for name, shape in shapes.items()}
    after, metrics = jax.eval_shape(scope["learn"], states, scope["Batch"](**rows_of), keys)
    assert action.shape == (seeds, 2) and metrics["critic/loss"].shape == (updates, seeds)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, states)


@pytest.mark.slow
def test_a_users_own_loop_learns(capsys):
    """Twenty lines beside the imports, compiled once: losses of four seeds, which differ."""
    scope = {}
    exec(compile(loop_example(), "docs/api.md", "exec"), scope)
    assert len(capsys.readouterr().out.splitlines()) == 4
    assert scope["learn"]._cache_size() == 1
    losses = scope["metrics"]["critic/loss"]
    assert losses.shape == (20, 4) and bool((losses[-1] < 1).all()) and len(set(losses[-1].tolist())) == 4


@pytest.mark.slow
def test_it_has_the_types_of_the_library(tmp_path):
    """As a user's editor checks it, and not without reading the signatures: a wrong argument is found."""
    program = loop_example()
    (tmp_path / "good.py").write_text(program)
    (tmp_path / "bad.py").write_text(
        program + "\nsac.update(config, states, 3, jax.random.key(0))\nsac.renew(config)\n"
    )
    # An editable install may be found by a hook alone, which no type checker runs.
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(HOOK.parent.parent)]}))
    check = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--project", str(tmp_path)]
    report = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True).stdout
    errors = [line for line in report.splitlines() if " error: " in line]
    assert len(errors) == 2 and all("bad.py" in line for line in errors), report
