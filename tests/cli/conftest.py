"""Running the command line in this process."""

import json
from dataclasses import dataclass
from typing import Any

import pytest

from inflight.cli import main


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@pytest.fixture
def inflight(capsys, monkeypatch):
    """Run one command line and return its exit code and what it printed."""
    # Wide and plain, so that assertions do not depend on the terminal the tests run in.
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")

    def run(*arguments: object) -> Outcome:
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Outcome(int(left.value.code or 0), printed.out, printed.err)

    return run
