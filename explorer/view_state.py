"""What a page shows, kept in its address: a link opens the same view."""

from __future__ import annotations

import datetime as dt

import panel as pn
import param


class ViewState(param.Parameterized):
    """Everything chosen in a page; names are those in the address."""

    comparison = param.String(default="", doc="Name of the comparison; the first one when empty.")
    first = param.String(default="", doc="First day, YYYY-MM-DD; that of the default span when empty.")
    last = param.String(default="", doc="Last day, YYYY-MM-DD.")
    tab = param.String(default="", doc="Heading of the tab in words of the address.")
    channel = param.String(default="", doc="What the residual is drawn against.")
    picture = param.String(default="", doc="Which picture stands below that.")
    select = param.String(default="", doc="Ranges of channels and phases that are looked at alone.")
    zoom = param.String(default="", doc="Visible span in time, UTC; the whole one when empty.")
    candidate = param.String(default="", doc="The chosen candidate.")
    dataset = param.String(default="", doc="Dataset whose calendar is shown; the product when empty.")
    day = param.String(default="", doc="The day chosen in it, YYYY-MM-DD.")

    def follow_address(self) -> None:
        """Take what the address says, and write what is chosen into it from now on."""
        if pn.state.location is not None:
            pn.state.location.sync(self, list(_IN_ADDRESS))
            # What is written before the browser has the page is lost.
            pn.state.onload(self._write_address)

    def _write_address(self) -> None:
        chosen = {name: value for name in _IN_ADDRESS if (value := getattr(self, name))}
        pn.state.location.update_query(**chosen)


def parsed_day(text: str) -> dt.date | None:
    """Return a day of the address; None for none, and for what is no day."""
    try:
        return dt.date.fromisoformat(text)
    except ValueError:
        return None


_CHOSEN = ("comparison", "first", "last", "tab", "channel", "picture", "select", "zoom", "candidate")
_IN_ADDRESS = (*_CHOSEN, "dataset", "day")
