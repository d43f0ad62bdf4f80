"""The habits a reader relies on: one version, a lock that is enough."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

import inflight

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SOURCES = sorted(
    path
    for folder in ("inflight", "catalog", "tasks", "flows", "serve", "explorer", "benchmarks", "docs")
    for path in (ROOT / folder).rglob("*.py")
    # A migration is a list of tables, and the built documentation is not source.
    if not {"_build", "migrations"} & set(path.parts)
)


def test_no_marks_are_left():
    mark = re.compile(r"\b(?:TO" + r"DO|FIX" + r"ME|XX" + r"X)\b")
    found = [str(path) for path in SOURCES if mark.search(path.read_text(encoding="utf-8"))]
    assert not found


def test_the_version_is_the_same_everywhere():
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert PROJECT["project"]["version"] == inflight.__version__ == citation["version"]


def locked() -> dict[str, str]:
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    pins = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", text, flags=re.MULTILINE)
    return {canonicalize_name(name): version for name, version in pins}


def test_the_lock_satisfies_every_declared_requirement():
    groups = [PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"].values()]
    pins = locked()
    for requirement in (Requirement(text) for group in groups for text in group):
        version = pins.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name} is not in the lock; run 'make lock'"
        assert requirement.specifier.contains(version), f"{requirement} but the lock has {version}"


def test_the_lock_names_no_package_host():
    assert "://" not in (ROOT / "requirements.lock").read_text(encoding="utf-8")


@pytest.mark.parametrize("target", ["setup", "demo", "test", "lint", "bench", "docs", "lock", "help"])
def test_make_help_lists_the_target(target):
    shown = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert re.search(rf"^  make {target} +\S", shown, flags=re.MULTILINE)


def test_the_check_of_a_clean_machine_runs_the_commands_of_the_readme():
    check = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for command in ("make lint", "make test", "make demo"):
        assert command in check
