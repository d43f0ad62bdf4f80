"""The wheel, the editable install and the folders of the repository are one package, `inflight`."""

import importlib
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOP_FOLDERS = ("catalog", "tasks", "flows", "serve", "explorer")


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """Build the wheel from a copy, because building leaves files beside the source."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for folder in ("inflight", "missions", *TOP_FOLDERS):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, source / folder, symlinks=True, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--no-index"]
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", *options, "-w", target, "."],
        cwd=source,
        check=True,
        timeout=120,
    )
    return next(target.glob("*.whl"))


@pytest.fixture(scope="session")
def unpacked(wheel, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run_python(code: str, cwd: Path, first_on_path: Path | None = None) -> subprocess.CompletedProcess[str]:
    prefix = f"import sys; sys.path.insert(0, {str(first_on_path)!r})\n" if first_on_path else ""
    # -P keeps the current folder off the path, as for an installed command.
    return subprocess.run(
        [sys.executable, "-P", "-c", prefix + code],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_wheel_holds_one_top_level_package(unpacked):
    names = {path.name for path in unpacked.iterdir() if not path.name.endswith(".dist-info")}
    assert names == {"inflight"}


def test_every_module_of_the_repository_is_in_the_wheel(unpacked):
    folders = {name: ROOT / name for name in TOP_FOLDERS} | {"": ROOT / "inflight"}
    expected = {
        str(Path("inflight") / name / path.relative_to(folder))
        for name, folder in folders.items()
        for path in folder.rglob("*.py")
    }
    present = {str(path.relative_to(unpacked)) for path in unpacked.rglob("*.py")}
    assert expected == present


def test_the_wheel_carries_types_missions_models_and_migrations(unpacked):
    package = unpacked / "inflight"
    assert (package / "py.typed").is_file()
    for folder in ("missions", "missions/models"):
        shipped = {path.name for path in (package / folder).glob("*.yaml")}
        assert shipped == {path.name for path in (ROOT / folder).glob("*.yaml")}
    assert list((package / "catalog" / "migrations" / "versions").glob("*.py"))


def test_an_installed_wheel_finds_its_shipped_missions(unpacked, tmp_path):
    code = (
        "import inflight\n"
        "from inflight.catalog.workspace import Workspace, shipped_missions\n"
        "assert 'conrad' in shipped_missions()\n"
        f"print(inflight.__file__, Workspace.create({str(tmp_path / 'work')!r}, 'conrad').mission().mission)"
    )
    result = run_python(code, tmp_path, first_on_path=unpacked)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [str(unpacked / "inflight" / "__init__.py"), "conrad"]


@pytest.mark.parametrize("name", [*TOP_FOLDERS, "missions"])
def test_nothing_generic_is_installed(name, unpacked, tmp_path):
    result = run_python(f"import {name}", tmp_path, first_on_path=unpacked)
    assert result.returncode != 0
    assert f"No module named '{name}'" in result.stderr


@pytest.mark.parametrize("name", TOP_FOLDERS)
def test_the_folders_are_the_package(name):
    module = importlib.import_module(f"inflight.{name}")
    assert Path(str(module.__file__)).samefile(ROOT / name / "__init__.py")


@pytest.mark.parametrize("name", TOP_FOLDERS)
def test_the_style_check_refuses_bare_names(name, tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", ROOT / "pyproject.toml", "--no-cache", "-"],
        input=f'"""Doc."""\n\nfrom {name} import something\n\nprint(something)\n',
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert result.returncode == 1
    assert f"import inflight.{name}" in result.stdout
