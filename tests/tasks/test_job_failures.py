"""A day that fails by a mistake of the software: what to report is in a file, and the file is named."""

from inflight.errors import SamplesError
from inflight.tasks.pipelines.base.job import failure_of


def raised():
    try:
        return 1 / 0
    except ZeroDivisionError as error:
        return error


def test_the_traceback_is_in_the_file_that_the_remedy_names(tmp_path):
    failure = failure_of(raised(), "r1 l2/field 2005-01-01", tmp_path)
    assert (failure.cause, failure.message) == ("bug", "ZeroDivisionError: division by zero")
    name = failure.remedy.removeprefix("please report it with ")
    text = (tmp_path / name).read_text(encoding="utf-8")
    assert "return 1 / 0" in text
    assert "r1 l2/field 2005-01-01" in text


def test_where_nothing_can_be_written_the_error_itself_is_named(tmp_path):
    (tmp_path / "reports").write_text("no folder", encoding="utf-8")
    failure = failure_of(raised(), "r1 l2/field 2005-01-01", tmp_path)
    assert failure.remedy == "please report it with this: ZeroDivisionError: division by zero"


def test_bad_input_is_no_mistake_of_the_software(tmp_path):
    failure = failure_of(SamplesError("no sample", remedy="look"), "r1", tmp_path)
    assert failure.remedy == "look"
    assert not list(tmp_path.iterdir())
