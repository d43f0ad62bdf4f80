"""Arrows between the layers go one way, and the core stays free of files and orchestration."""

import ast
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
LAYERS = (
    "inflight.catalog",
    "inflight.tasks",
    "inflight.flows",
    "inflight.serve",
    "inflight.explorer",
    "inflight.cli",
)
#: What only the catalog and what stands above it may use.
STORAGE_AND_ORCHESTRATION = (
    "zarr",
    "sqlalchemy",
    "alembic",
    "prefect",
    "dask",
    "distributed",
    "cdflib",
    "h5py",
    "panel",
)
#: Calls that open, read or write a file.
FILE_CALLS = {"open", "read_text", "write_text", "read_bytes", "write_bytes", "to_zarr", "to_netcdf", "mkdir"}


@pytest.fixture(scope="module")
def graph():
    return grimp.build_graph("inflight", include_external_packages=True, cache_dir=None)


def in_layer(module: str, layer: str) -> bool:
    return module == layer or module.startswith(f"{layer}.")


def core_modules(graph) -> list[str]:
    # `python -m inflight` is the command line, by its place alone in the package of the physics.
    inside = [name for name in graph.modules if in_layer(name, "inflight") and name != "inflight.__main__"]
    return [name for name in inside if not any(in_layer(name, layer) for layer in LAYERS)]


@pytest.mark.parametrize("position", range(len(LAYERS)))
def test_no_layer_imports_one_above_it(graph, position):
    layer, above = LAYERS[position], LAYERS[position + 1 :]
    upward = [
        (module, imported)
        for module in graph.modules
        if in_layer(module, layer)
        for imported in graph.find_modules_directly_imported_by(module)
        if any(in_layer(imported, other) for other in above)
    ]
    assert not upward


def test_the_core_imports_no_layer_and_no_storage(graph):
    found = [
        (module, imported)
        for module in core_modules(graph)
        for imported in graph.find_modules_directly_imported_by(module)
        if any(in_layer(imported, name) for name in (*LAYERS, *STORAGE_AND_ORCHESTRATION))
    ]
    assert len(core_modules(graph)) > 20
    assert not found


def test_the_simulator_shares_no_physics_with_the_calibration(graph):
    shared = ("inflight.effects", "inflight.model", "inflight.calibration", *LAYERS)
    reached = {
        other
        for module in graph.modules
        if in_layer(module, "inflight.simulate")
        for other in graph.find_upstream_modules(module)
        if any(in_layer(other, name) for name in shared)
    }
    assert not reached


def test_the_core_opens_no_file():
    calls = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in core_files()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and called_name(node) in FILE_CALLS
    ]
    assert not calls


def core_files() -> list[Path]:
    folders = [path for path in (ROOT / "inflight").iterdir() if path.is_dir() and not path.is_symlink()]
    inner = [
        path
        for folder in folders
        if folder.name not in ("cli", "__pycache__")
        for path in folder.rglob("*.py")
    ]
    return [*(ROOT / "inflight").glob("*.py"), *inner]


def called_name(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def test_the_written_contracts_hold(monkeypatch, capsys):
    from importlinter import cli

    monkeypatch.chdir(ROOT)
    assert cli.lint_imports(no_cache=True) == 0, capsys.readouterr().out
