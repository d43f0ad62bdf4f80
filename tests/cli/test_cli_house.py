"""Manners of the command line: help, version, errors, exit codes."""

import os
import subprocess
import sys

import pytest

import inflight as package
from inflight.cli.command import Command, run_verb
from inflight.errors import CatalogError

VERBS = ["new", "simulate", "ingest", "reprocess", "backfill", "compare", "catalog", "release", "demo"]


def test_help_names_every_verb_and_the_exit_codes(inflight):
    shown = inflight("--help")
    assert shown.code == 0
    assert all(f" {verb} " in shown.out for verb in VERBS)
    assert "3 done with days missing" in shown.out


@pytest.mark.parametrize("verb", [*VERBS[:6], "release", "demo"])
def test_every_verb_takes_the_common_options(inflight, verb):
    shown = inflight(verb, "--help").out
    for option in ("--workspace", "--json", "--debug"):
        assert option in shown


def test_version_is_the_packages(inflight):
    assert inflight("--version").out.strip() == f"inflight {package.__version__}"


def test_the_package_runs_as_a_module():
    command = [sys.executable, "-m", "inflight", "--version"]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.stdout.strip() == f"inflight {package.__version__}"


def test_help_answers_at_once_because_nothing_heavy_is_imported():
    code = (
        "import sys\nfrom inflight.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'xarray', 'pydantic', 'prefect', 'dask', 'sqlalchemy'} & set(sys.modules)\n"
        "sys.exit(f'imported {sorted(heavy)}' if heavy else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("stated", ["", "3"])
def test_products_of_matrices_take_one_thread_unless_the_user_says_otherwise(stated):
    code = (
        "import os\nfrom inflight.cli import main\n"
        "try:\n    main(['--version'])\nexcept SystemExit:\n    pass\n"
        "print(*(os.environ[name] for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS')))"
    )
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment |= {"OPENBLAS_NUM_THREADS": stated} if stated else {}
    told = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert told.stdout.split()[-2:] == [stated or "1", "1"]


def test_a_folder_that_is_no_workspace_is_wrong_usage_with_a_remedy(inflight, tmp_path):
    told = inflight("catalog", "list", "--workspace", tmp_path)
    assert told.code == 2
    assert told.out == ""
    assert "no workspace" in told.err
    assert "inflight new" in told.err
    assert "Traceback" not in told.err


def test_an_error_is_one_json_object_on_standard_output(inflight, tmp_path):
    told = inflight("--json", "catalog", "list", "-w", tmp_path)
    assert told.code == 2
    assert set(told.json["error"]) == {"kind", "message", "remedy", "file", "channel", "day"}
    assert told.json["error"]["kind"] == "WorkspaceError"


def test_an_unknown_option_is_wrong_usage_in_both_languages(inflight):
    assert inflight("reprocess", "--bogus").code == 2
    told = inflight("reprocess", "--bogus", "--json")
    assert told.code == 2
    assert "--bogus" in told.json["error"]["message"]


def test_options_behind_the_verb_win_over_those_before_it(inflight, tiny_workspace, tmp_path):
    told = inflight("-w", tmp_path, "catalog", "list", "-w", tiny_workspace, "--json")
    assert told.code == 0
    assert told.json["items"] == []


@pytest.mark.parametrize(
    ("error", "code", "kind"),
    [
        (CatalogError("gone", remedy="look"), 1, "CatalogError"),
        (ZeroDivisionError("oops"), 1, "ZeroDivisionError"),
    ],
)
def test_what_a_verb_raises_becomes_message_and_exit_code(capsys, error, code, kind):
    import typer

    def work():
        raise error

    with pytest.raises(typer.Exit) as left:
        run_verb(Command(json=True), work)
    assert left.value.exit_code == code
    assert f'"kind": "{kind}"' in capsys.readouterr().out


def test_a_traceback_is_shown_only_when_asked_for(capsys):
    import typer

    def work():
        raise ZeroDivisionError("oops")

    for debug in (False, True):
        with pytest.raises(typer.Exit):
            run_verb(Command(debug=debug), work)
        assert ("Traceback" in capsys.readouterr().err) is debug


def test_a_day_that_is_no_date_is_wrong_usage(inflight, tiny_workspace):
    told = inflight("reprocess", "--start", "soon", "-w", tiny_workspace, "--json", "--no-prefect")
    assert told.code == 2
    assert "start" in told.json["error"]["message"]


def test_a_span_that_runs_backwards_is_wrong_usage(inflight, tiny_workspace):
    span = ("--start", "2024-03-03", "--end", "2024-03-01")
    told = inflight("ingest", *span, "-w", tiny_workspace, "--json", "--no-prefect")
    assert told.code == 2
    assert "holds no day" in told.json["error"]["message"]


@pytest.mark.parametrize("after", [KeyboardInterrupt, ConnectionRefusedError])
def test_an_interruption_is_no_defect_whatever_it_turns_into(capsys, after):
    """The embedded server hears Ctrl-C, too; the error of its absence must not be what is told."""
    import signal

    import typer

    def work():
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise after from None

    with pytest.raises(typer.Exit) as left:
        run_verb(Command(), work)
    assert left.value.exit_code == 130
    told = capsys.readouterr().err
    assert "interrupted" in told
    assert "defect" not in told
