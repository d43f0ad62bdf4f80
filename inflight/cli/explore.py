"""The verb ``explore``: the workspace in the browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from inflight.cli.pipeline import WorkersOption
from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console


def register(app: typer.Typer) -> None:
    """Add the verb of this module."""
    verb(app, "explore")(explore)


def explore(
    session: Session,
    *,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of this machine (default: a free one).")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only say where the page is, open no browser.")
    ] = False,
    workers: WorkersOption = None,
) -> None:
    """Explore the workspace in the browser: model against measurement, the missing effect, tables.

    Serves this machine alone until Ctrl-C.
    """
    workspace = session.open_workspace()
    workspace.mission()
    from inflight.explorer import Server

    server = Server(workspace, port, workers)

    def ready(url: str) -> None:
        def show(console: Console) -> None:
            console.print(f"{url}  (Ctrl-C ends it)", soft_wrap=True)

        session.emit({"command": "explore", "url": url, "workspace": str(workspace.root)}, show)
        if not (no_browser or session.json):
            import webbrowser

            webbrowser.open(url)

    server.run(ready)
