"""Pictures of days: ranges keep every spike, gaps stay gaps, missing days say why."""

from xml.etree import ElementTree

import numpy as np

from inflight.figures.quicklook import CalendarDay, Panel, calendar_page, day_picture, ranges


def test_ranges_keep_a_spike_and_leave_gaps():
    part = np.arange(1000) / 1000
    values = np.sin(part)
    values[500] = 99.0
    values[200:300] = np.nan
    low, high = ranges(part, values, 10)
    assert high[5] == 99.0
    assert np.isnan(low[2])
    assert np.isnan(high[2])
    assert low[0] == values[0]


def test_a_day_is_drawn_as_svg_that_a_parser_takes():
    part = np.linspace(0, 1, 500, endpoint=False)
    panel = Panel("field <nec>", "nT", ["north", "east"], np.stack([part, -part], axis=1))
    picture = day_picture("a & b", part, [panel], part > 0.9)
    tree = ElementTree.fromstring(picture)
    texts = [one.text for one in tree.iter() if one.text]
    assert "a & b" in texts
    assert any("field <nec> (nT)" in text for text in texts)
    assert sum(one.get("fill") == "#b00" for one in tree.iter()) == 45


def test_days_without_data_are_drawn_without_a_curve():
    part = np.linspace(0, 1, 10, endpoint=False)
    picture = day_picture("day", part, [Panel("field", "nT", [""], np.full((10, 1), np.nan))], part < 0)
    ElementTree.fromstring(picture)
    assert 'd=""' in picture


def test_the_calendar_links_days_and_says_why_others_are_missing():
    edges = np.full(42, 1.0)
    days = {
        np.datetime64("2005-01-31"): CalendarDay("v01.00", "2005/2005-01-31.svg", -edges, edges),
        np.datetime64("2005-02-01"): CalendarDay("repeatable"),
    }
    page = calendar_page("l2/field, 2005", "residual", days)
    assert page.count('href="2005/2005-01-31.svg"') == 1
    assert "January 2005" in page
    assert "February 2005" in page
    assert "repeatable" in page
