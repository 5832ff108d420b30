"""Impure: prints `name==version` of the requirements in pyproject.toml, with extras dev and export, as installed."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

PYPROJECT = Path(__file__).parent.parent / "pyproject.toml"


def closure(wanted: list[str]) -> dict[str, str]:
    """{name: version} of these requirements and of all that they need in turn on this machine."""
    versions: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(line, "") for line in wanted]
    while waiting:
        line, extra = waiting.pop()
        requirement = Requirement(line)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        package = importlib.metadata.distribution(requirement.name)
        versions[_canonical(requirement.name)] = package.version
        for own in {"", *requirement.extras}:
            if (requirement.name, own) not in seen:
                seen.add((requirement.name, own))
                waiting += [(needed, own) for needed in package.requires or []]
    return versions


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    print("# Exact versions this project is tested with; `make lock` writes this file, `make setup` installs from it.")
    extras = project["optional-dependencies"]
    for name, version in sorted(closure(project["dependencies"] + extras["dev"] + extras["export"]).items()):
        print(f"{name}=={version}")
