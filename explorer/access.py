"""Who may see the page: only who has the token, which the address that is printed holds.

The first request brings the token in its address; the answer keeps it as a cookie and goes to the same
address without it, so that a link that is copied does not give the page away. Every other request, of files
and of the page's socket, too, is refused without the cookie. Other programs of this machine, other people's
pages in the same browser, and names of other hosts that lead here have neither.
"""

from __future__ import annotations

import secrets
from hmac import compare_digest
from typing import Any
from urllib.parse import parse_qsl, urlencode

from tornado.httputil import HTTPServerRequest
from tornado.routing import Matcher, Rule
from tornado.web import Application, RequestHandler

from inflight.figures import render

#: Name of the token in the address.
TOKEN = "token"


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(24)


def require_token(application: Application, token: str, port: int) -> None:
    """Refuse requests without a token, whatever they ask for.

    Parameters
    ----------
    application : tornado.web.Application
        Of the server; rules that are added stand before its own.
    token : str
    port : int
        Servers of one machine share its cookies: each has one of its own.
    """
    cookie = f"inflight-{port}"
    options = {"token": token, "cookie": cookie}
    application.add_handlers(
        ".*",
        [
            Rule(_WithTokenInAddress(token), _TakeToken, options),
            Rule(_WithoutCookie(token, cookie), _Refuse),
        ],
    )


class _WithTokenInAddress(Matcher):
    def __init__(self, token: str) -> None:
        self._token = token

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        given = request.query_arguments.get(TOKEN, [b""])[-1]
        return {} if request.method == "GET" and compare_digest(given, self._token.encode()) else None


class _WithoutCookie(Matcher):
    def __init__(self, token: str, cookie: str) -> None:
        self._token, self._cookie = token, cookie

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        given = request.cookies.get(self._cookie)
        known = given is not None and compare_digest(given.value.encode(), self._token.encode())
        return None if known else {}


class _TakeToken(RequestHandler):
    """Keep the token as a cookie, and go to the address without it."""

    def initialize(self, token: str, cookie: str) -> None:
        self._token, self._cookie = token, cookie

    def get(self) -> None:
        # Not for scripts, nor for requests that pages of others make.
        self.set_cookie(self._cookie, self._token, httponly=True, samesite="Lax")
        self.set_header("Cache-Control", "no-store")
        rest = urlencode([(name, value) for name, value in parse_qsl(self.request.query) if name != TOKEN])
        # Two slashes would name another host.
        path = f"/{self.request.path.lstrip('/')}"
        self.redirect(f"{path}?{rest}" if rest else path)


class _Refuse(RequestHandler):
    """Say what to do, and nothing of the workspace."""

    def prepare(self) -> None:
        self.set_status(403)
        self.set_header("Cache-Control", "no-store")
        self.finish(str(render("refused.html")))

    def check_xsrf_cookie(self) -> None:
        """Nothing is done here that a forged request could do."""
