"""The server that listens: one process, until it is interrupted."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from typing import Final

import uvicorn

from inflight.errors import InflightError, SettingsError
from inflight.serve.datasets import Collection
from inflight.serve.hapi import make_app

#: Seconds that requests under way have to end after Ctrl-C.
_GRACE_S: Final = 2


def _is_news(record: logging.LogRecord) -> bool:
    """Return False for what is no defect, or was told: an answer that Ctrl-C or a damaged store ended."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, asyncio.CancelledError | InflightError)


class Server:
    """A server of a collection, listening once it is made.

    Parameters
    ----------
    collection : Collection
        What is served.
    host : str
        Address to listen on.
    port : int
        0 takes a free one.

    Raises
    ------
    SettingsError
        When it cannot be listened on.
    """

    def __init__(self, collection: Collection, host: str = "127.0.0.1", port: int = 0) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            raise SettingsError(
                f"--host, --port: {host} {port} cannot be listened on: {error.strerror or error}",
                remedy="name another port, 0 for a free one, or an address of this machine",
            ) from None
        config = uvicorn.Config(
            make_app(collection),
            log_level="warning",
            access_log=False,
            server_header=False,
            lifespan="off",
            timeout_graceful_shutdown=_GRACE_S,
        )
        logging.getLogger("uvicorn.error").addFilter(_is_news)
        self._server = uvicorn.Server(config)
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._socket.getsockname()[1]}/hapi"

    def run(self, ready: Callable[[str], None]) -> None:
        """Serve until interrupted; `ready` is called with the address first.

        Ctrl-C is how it ends, not an error.
        """
        ready(self.url)
        try:
            self._server.run(sockets=[self._socket])
        except KeyboardInterrupt:
            pass
        finally:
            self._socket.close()
