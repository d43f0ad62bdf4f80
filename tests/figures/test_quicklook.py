"""Pictures of days: ranges keep every spike, gaps stay gaps, missing days say why."""

from xml.etree import ElementTree

import numpy as np

from inflight.figures.quicklook import (
    CalendarDay,
    ChangePanel,
    Panel,
    calendar_page,
    changes_picture,
    day_picture,
    ranges,
)


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


def test_changes_stand_at_their_time_and_height():
    start = np.array(["2005-01-01", "2005-01-03"], "datetime64[D]")
    panel = ChangePanel("offset", "nT", start, start + 1, np.array([2.0, -1.0]), np.array([0.5, 0.5]))
    picture = ElementTree.fromstring(changes_picture("1 to 2", [panel]))
    band, zero, curve = (one.get("d") for one in picture.iter() if one.tag.endswith("path"))
    # 900 pixels of three days; 150 of twice 2.1 nT.
    assert curve == f"M0.0,{150 * (2.1 - 2) / 4.2:.1f}H300.0M600.0,{150 * (2.1 + 1) / 4.2:.1f}H900.0"
    assert zero == "M0,75.0H900"
    assert band.startswith(f"M0.0,{150 * (2.1 - 0.5) / 4.2:.1f}H300.0V{150 * (2.1 + 0.5) / 4.2:.1f}H0.0z")


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
