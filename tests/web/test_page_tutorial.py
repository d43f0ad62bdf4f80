"""The tutorial of the page, done from its first line to its last in a real browser."""

from pathlib import Path

import pytest
from played_page import PlayedPage

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial-explorer.md"


@pytest.mark.slow
def test_the_tutorial_of_the_page_does_what_it_says(browser, serve, tmp_path):
    browser.look(1440, 1300)
    played = PlayedPage(browser, tmp_path, lambda root: serve(root).url)
    played.play(TUTORIAL.read_text(encoding="utf-8"))
    assert {"press", "fill", "drag", "open_tab", "read"} <= set(played.done)
    assert browser.complaints == []


def test_a_page_that_tells_what_is_not_there_is_no_tutorial(tmp_path):
    played = PlayedPage(None, tmp_path, str)
    with pytest.raises(AssertionError, match="no instruction"):
        played.play("Find the button **Guess** and wait.")
