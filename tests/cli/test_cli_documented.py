"""The written reference names every verb and option there is, and no other verb."""

import re
from pathlib import Path

import pytest
import typer

from inflight.cli.app import app

ROOT = Path(__file__).parents[2]
REFERENCE = (ROOT / "docs" / "reference" / "command-line.md").read_text(encoding="utf-8")


def verbs() -> dict[str, set[str]]:
    """Return verb -> its long options."""

    def leaves(name, command):
        if inner := getattr(command, "commands", None):
            for sub, leaf in inner.items():
                yield from leaves(f"{name} {sub}".strip(), leaf)
        else:
            yield name, {text for item in command.params for text in item.opts if text.startswith("--")}

    return dict(leaves("", typer.main.get_command(app)))


@pytest.mark.parametrize("verb", sorted(verbs()))
def test_the_reference_names_the_verb_with_its_options(verb):
    row = next((line for line in REFERENCE.splitlines() if line.startswith(f"| `{verb}")), "")
    assert row, f"docs/reference/command-line.md lacks `{verb}`"
    common = {"--workspace", "--json", "--debug", "--help"}
    missing = {option for option in verbs()[verb] - common if f"`{option}`" not in row}
    assert not missing


def test_the_reference_names_no_verb_that_is_not_there():
    named = re.findall(r"^\| `([a-z]+(?: [a-z]+)*)", REFERENCE, flags=re.MULTILINE)
    assert named
    assert set(named) <= set(verbs())


@pytest.mark.parametrize(
    "page", ["README.md", "docs/tutorial.md", "docs/how-to/backfill.md", "docs/how-to/two-sensors.md"]
)
def test_commands_shown_in_the_pages_exist(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    shown = re.findall(r"^inflight (?:-\S+ \S+ )*([a-z]+)((?: [a-z]+)?)(.*)$", text, flags=re.MULTILINE)
    assert shown
    for verb, second, rest in shown:
        known = verb if verb in verbs() else f"{verb}{second}"
        assert known in verbs(), f"{page} shows `inflight {known}`"
        options = set(re.findall(r"(--[a-z-]+)", rest.split("#")[0]))
        assert options <= verbs()[known] | {"--workspace"}
