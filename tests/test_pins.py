"""constraints.txt pins what the package, its extras and its dependency groups require."""

import re
import tomllib

from tests.shared_data import ROOT

NAME = re.compile(r"[A-Za-z0-9._-]+")


def names(lines: list[str]) -> set[str]:
    found = [NAME.match(line) for line in lines]
    return {re.sub(r"[-_.]+", "-", each[0].lower()) for each in found if each}


def test_every_requirement_is_pinned() -> None:
    pinned = (ROOT / "constraints.txt").read_text().splitlines()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    required = [
        *project["build-system"]["requires"],
        *project["project"]["dependencies"],
        *(line for extra in project["project"]["optional-dependencies"].values() for line in extra),
        *(line for group in project["dependency-groups"].values() for line in group),
    ]
    assert names(required) - {"faintspot"} <= names(pinned)
    assert not [line for line in pinned if not re.fullmatch(r"[\w.-]+==[\w.]+( ; .+)?", line)]
