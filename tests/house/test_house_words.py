"""The dictionary names modules that exist, and every public class it names stands where it says."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENTRIES = re.findall(
    r"^\*.*?\((`inflight[^)]*)\)\n((?:[: ] .*\n)+)",
    (ROOT / "docs" / "reference" / "words.md").read_text(encoding="utf-8"),
    re.MULTILINE,
)


def test_every_entry_names_its_module():
    text = (ROOT / "docs" / "reference" / "words.md").read_text(encoding="utf-8")
    assert len(ENTRIES) == len(re.findall(r"^\*", text, re.MULTILINE)) > 70


@pytest.mark.parametrize("modules", sorted({modules for modules, _ in ENTRIES}))
def test_a_word_lives_where_the_dictionary_says(modules):
    for name in re.findall(r"`([\w.]+)`", modules):
        assert importlib.util.find_spec(name) is not None, name


@pytest.mark.parametrize(("modules", "text"), ENTRIES)
def test_a_class_of_a_word_is_defined_there(modules, text):
    for name in re.findall(r"(?:^|\. |A )`([A-Z][A-Za-z]+)`", text):
        sources = [
            Path(importlib.util.find_spec(module).origin).read_text(encoding="utf-8")
            for module in re.findall(r"`([\w.]+)`", modules + text)
            if module.startswith("inflight")
        ]
        assert any(re.search(rf"^(class )?{name}\b", source, re.MULTILINE) for source in sources), name
