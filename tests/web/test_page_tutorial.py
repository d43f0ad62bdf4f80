"""What plays the tutorial of the page in a browser (`docs/make_pictures.py explorer`) does what it knows."""

import pytest
from played_page import PlayedPage


def test_a_page_that_tells_what_is_not_there_is_no_tutorial(tmp_path):
    played = PlayedPage(None, tmp_path, str)
    with pytest.raises(AssertionError, match="no instruction"):
        played.play("Find the button **Guess** and wait.")
