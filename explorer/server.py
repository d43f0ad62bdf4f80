"""The web server of the page, on the local machine only; it requests nothing from other servers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn

from inflight.catalog import Workspace
from inflight.errors import SettingsError
from inflight.explorer.access import TOKEN, new_token, require_token
from inflight.explorer.page import open_page
from inflight.explorer.session import ExplorerSession

#: Local only: the page changes models.
ADDRESS = "127.0.0.1"


class Server:
    """A server of one workspace's page, listening once it is made.

    Parameters
    ----------
    workspace : Workspace
        Opened.
    port : int
        0 takes a free one.
    workers : int, optional
        Dask processes of a pass.
    with_token : bool
        Show the page only to who has the token of its address.
    allow_code : bool
        Run the files of Python that the mission names.

    Raises
    ------
    SettingsError
        When the port is taken, or the mission names files of Python that may not be run.
    """

    def __init__(
        self,
        workspace: Workspace,
        port: int = 0,
        workers: int | None = None,
        *,
        with_token: bool = True,
        allow_code: bool = False,
    ) -> None:
        self.session = ExplorerSession(workspace, workers, allow_code=allow_code)
        self.session.mission()

        def page() -> Any:
            return open_page(self.session)

        try:
            self._server = pn.serve(
                {"/": page},
                port=port,
                address=ADDRESS,
                show=False,
                start=False,
                verbose=False,
                title=f"Inflight {workspace.root.resolve().name}",
            )
        except OSError as error:
            raise SettingsError(
                f"--port: {port} cannot be listened on: {error.strerror or error}",
                remedy="name another port, or none to take a free one",
            ) from None
        self.url = f"http://{ADDRESS}:{self._server.port}/"
        if with_token:
            token = new_token()
            require_token(self._server._tornado, token, self._server.port)
            self.url += f"?{TOKEN}={token}"

    def run(self, ready: Callable[[str], None]) -> None:
        """Serve until interrupted; `ready` is called with the address first.

        Ctrl-C is how it ends, not an error.
        """
        self._server.start()
        ready(self.url)
        try:
            self._server.io_loop.start()
        except KeyboardInterrupt:
            pass
        finally:
            self.session.close()
            self._server.stop()
