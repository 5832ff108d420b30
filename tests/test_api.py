"""docs/api.md lists every public name, nothing else, and all of them explain themselves."""

import functools
import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest

import envs
import sgft_jax

PAGE = (Path(__file__).parent.parent / "docs/api.md").read_text()
LISTED = re.findall(r"^\| `([\w.]+)` \| .+ \|$", PAGE, re.M)


def names_of(module):
    """The public names of a package; of its modules, what they define themselves unless the package has it already."""
    names = [f"{module.__name__}.{name}" for name in module.__all__]
    own = {id(getattr(module, name)) for name in module.__all__}
    for sub in [x for x in vars(module).values() if isinstance(x, ModuleType) and x.__name__ in names]:
        defined = [(k, x) for k, x in vars(sub).items() if inspect.isroutine(x) or inspect.isclass(x)]
        mine = [(k, x) for k, x in defined if x.__module__ == sub.__name__ and not k.startswith("_")]
        names += [f"{sub.__name__}.{k}" for k, x in mine if id(x) not in own]
    return names


def resolve(name):
    package, *parts = name.split(".")
    return functools.reduce(getattr, parts, {"sgft_jax": sgft_jax, "envs": envs}[package])


def test_the_page_lists_every_public_name_once_and_no_other():
    assert sorted(LISTED) == sorted(names_of(sgft_jax) + names_of(envs))


@pytest.mark.parametrize("name", LISTED)
def test_public_names_explain_themselves(name):
    thing = resolve(name)
    if inspect.isroutine(thing) or inspect.isclass(thing) or isinstance(thing, ModuleType):
        doc = inspect.getdoc(thing) or ""
        assert len(doc) > 20 and not doc.startswith(f"{name.rpartition('.')[2]}("), "no docstring of its own"


@pytest.mark.parametrize("package", [sgft_jax, envs], ids=lambda package: package.__name__)
def test_all_is_sorted_and_there(package):
    assert all(hasattr(package, name) for name in package.__all__)
    assert len(set(package.__all__)) == len(package.__all__)
