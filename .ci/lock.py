"""Impure: prints `name==version` of everything that this project and its dev extra need, as installed here."""

import importlib.metadata
import re

from packaging.requirements import Requirement

PROJECT, EXTRA = "sgft-jax", "dev"


def closure(root: str, extra: str) -> dict[str, str]:
    """{name: version} of all direct and indirect dependencies whose markers hold on this machine."""
    versions: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(root, ""), (root, extra)]
    while waiting:
        name, wanted = waiting.pop()
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        package = importlib.metadata.distribution(name)
        versions[_canonical(name)] = package.version
        for line in package.requires or []:
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": wanted}):
                waiting += [(requirement.name, e) for e in ("", *requirement.extras)]
    del versions[root]
    return versions


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    print("# Exact versions this project is tested with; `make lock` writes this file, `make setup` installs from it.")
    for name, version in sorted(closure(PROJECT, EXTRA).items()):
        print(f"{name}=={version}")
