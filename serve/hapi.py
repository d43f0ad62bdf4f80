"""The endpoints of HAPI 3.2: a request is read strictly, answered from a `Collection`, or refused by code.

Only GET and HEAD are answered, nothing is ever changed, and no text of a request is repeated in an answer.
Samples are sent as they are read, a block at a time, so that a request over years needs the memory of a day.

Reference: HAPI data access specification 3.2, sections 3 (endpoints) and 4 (status codes).
"""

from __future__ import annotations

import html
import itertools
import json
import logging
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from email.utils import format_datetime
from typing import Any, Final

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route

from inflight import __version__
from inflight.errors import InflightError
from inflight.serve.datasets import Collection, Served
from inflight.serve.records import TIME, Parameter, binary_records, csv_records
from inflight.serve.times import day_text, parse_time

VERSION: Final = "3.2"
#: Code -> HTTP status and message, as section 4.2 has them.
STATUS: Final[Mapping[int, tuple[int, str]]] = {
    1200: (200, "OK"),
    1201: (200, "OK - no data for time range"),
    1400: (400, "Bad request - user input error"),
    1401: (400, "Bad request - unknown API parameter name"),
    1402: (400, "Bad request - syntax error in start time"),
    1403: (400, "Bad request - syntax error in stop time"),
    1404: (400, "Bad request - start equal to or after stop"),
    1405: (400, "Bad request - start < startDate and/or stop > stopDate"),
    1406: (404, "Bad request - unknown dataset id"),
    1407: (404, "Bad request - unknown dataset parameter"),
    1409: (400, "Bad request - unsupported output format"),
    1410: (400, "Bad request - unsupported include value"),
    1411: (400, "Bad request - out-of-order or duplicate parameters"),
    1412: (400, "Bad request - unsupported resolve_references value"),
    1413: (400, "Bad request - unsupported depth value"),
    1500: (500, "Internal server error"),
}
#: Format -> media type and encoder of a block of samples.
_FORMATS: Final = {
    "csv": ("text/csv", csv_records),
    "binary": ("application/octet-stream", binary_records),
}
#: Names of HAPI 2 that servers of HAPI 3 still take.
_OLD_NAMES: Final = {"id": "dataset", "time.min": "start", "time.max": "stop"}
_OF_INFO: Final = frozenset({"dataset", "parameters", "resolve_references"})
#: Endpoint -> the names a request may have.
_NAMES: Final = {
    "about": frozenset[str](),
    "capabilities": frozenset[str](),
    "catalog": frozenset({"depth"}),
    "info": _OF_INFO,
    "data": _OF_INFO | {"start", "stop", "include", "format"},
}
#: What pages of other sites may do: read, as the standard recommends for public data.
_HEADERS: Final = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Allow-Methods": "GET",
    "Access-Control-Allow-Headers": "Content-Type",
}
#: What goes wrong on the server's side, for who runs it.
LOG: Final = logging.getLogger("inflight.serve")


class RefusedError(Exception):
    """A request that the standard refuses; the remark never holds a text of the request."""

    def __init__(self, code: int, remark: str = "", http: int = 0) -> None:
        super().__init__(remark)
        self.code, self.remark, self.http = code, remark, http or STATUS[code][0]


@dataclass(frozen=True)
class DataRequest:
    """What a valid request to ``data`` asks for; instants are TT2000, half-open."""

    served: Served
    parameters: Sequence[Parameter]
    start: int
    stop: int
    format: str = "csv"
    with_header: bool = False
    accepts_gzip: bool = False


def make_app(collection: Collection) -> Starlette:
    """Return the ASGI application that serves a collection below ``/hapi``."""

    def endpoint(request: Request) -> Response:
        return _answered(lambda: _answer(collection, request))

    def failed(_request: Request, error: Exception) -> Response:
        status = error.status_code if isinstance(error, HTTPException) else 500
        if status == 405:
            return _refusal(RefusedError(1400, "only GET and HEAD are answered", 405), {"Allow": "GET, HEAD"})
        return _refusal(RefusedError(1400, "everything is below /hapi", 404))

    return Starlette(
        routes=[
            Route("/", lambda _: RedirectResponse("/hapi"), methods=["GET"]),
            Route("/hapi", endpoint, methods=["GET"]),
            Route("/hapi/{endpoint:path}", endpoint, methods=["GET"]),
        ],
        exception_handlers={HTTPException: failed},
    )


def _answered(work: Callable[[], Response]) -> Response:
    """Return the answer, or the refusal of whatever goes wrong on the way to it."""
    try:
        return work()
    except RefusedError as refused:
        return _refusal(refused)
    except InflightError as error:
        LOG.error("%s", error)
        return _refusal(RefusedError(1500, "the release cannot be read; who runs the server sees why"))
    except Exception:
        LOG.exception("a request failed")
        return _refusal(RefusedError(1500))


def _answer(collection: Collection, request: Request) -> Response:
    name = request.path_params.get("endpoint", "")
    if not name:
        _require_names(request, frozenset())
        return HTMLResponse(_landing_page(collection), headers=_HEADERS)
    if name not in _NAMES:
        raise RefusedError(1400, f"the endpoints are {', '.join(_NAMES)}")
    given = _require_names(request, _NAMES[name])
    if name == "data":
        return _data_response(_data_request(collection, given, request), request.method == "HEAD")
    if name == "info":
        served = _served(collection, given)
        fields, newest = served.info(_parameters(served, given)), served.release.created
    else:
        fields = _METADATA[name](collection, given)
        newest = max(served.release.created for served in collection.datasets())
    headers = {"Last-Modified": format_datetime(datetime.fromisoformat(newest), usegmt=True)}
    return _json(_with_status(fields), headers=headers)


# --- reading requests ----------------------------------------------------------------------------


def _require_names(request: Request, allowed: frozenset[str]) -> dict[str, str]:
    """Return what a request gives, by the names of HAPI 3."""
    given: dict[str, str] = {}
    for name, value in request.query_params.multi_items():
        known = _OLD_NAMES.get(name, name)
        if known not in allowed:
            names = ", ".join(sorted(allowed)) or "none"
            raise RefusedError(1401, f"this endpoint takes {names}")
        if known in given:
            raise RefusedError(1400, "a name is given twice")
        given[known] = value
    return given


def _served(collection: Collection, given: Mapping[str, str]) -> Served:
    if not given.get("dataset"):
        raise RefusedError(1400, "the dataset is missing")
    served = collection.find(given["dataset"])
    if served is None:
        raise RefusedError(1406, "/hapi/catalog lists those there are")
    if given.get("resolve_references", "true") not in ("true", "false"):
        raise RefusedError(1412, "it is true or false")
    return served


def _parameters(served: Served, given: Mapping[str, str]) -> list[Parameter]:
    """Return the parameters asked for, without the time; all when none is named."""
    if not given.get("parameters"):
        return list(served.parameters.values())
    names, known = given["parameters"].split(","), [TIME, *served.parameters]
    if any(name not in known for name in names):
        raise RefusedError(1407, "/hapi/info lists those there are")
    places = [known.index(name) for name in names]
    if any(later <= earlier for earlier, later in itertools.pairwise(places)):
        raise RefusedError(1411, "name each once, in the order of /hapi/info")
    return [served.parameters[name] for name in names if name != TIME]


def _data_request(collection: Collection, given: Mapping[str, str], request: Request) -> DataRequest:
    served = _served(collection, given)
    parameters = _parameters(served, given)
    if given.get("include", "header") != "header":
        raise RefusedError(1410, "it is header")
    form = given.get("format", "csv")
    if form not in _FORMATS:
        raise RefusedError(1409, f"the formats are {', '.join(_FORMATS)}")
    start, stop = _instant(given, "start", 1402), _instant(given, "stop", 1403)
    if start >= stop:
        raise RefusedError(1404)
    if start < served.start or stop > served.stop:
        days = served.release.datasets[served.dataset]
        raise RefusedError(1405, f"the days are {days[0]} to {days[1]}, both whole")
    return DataRequest(
        served=served,
        parameters=parameters,
        start=start,
        stop=stop,
        format=form,
        with_header="include" in given,
        accepts_gzip="gzip" in request.headers.get("accept-encoding", ""),
    )


def _instant(given: Mapping[str, str], name: str, code: int) -> int:
    try:
        return parse_time(given.get(name, ""))
    except ValueError:
        raise RefusedError(code, "write it as 2005-01-31T12:00:00.000Z or 2005-031T12:00:00.000Z") from None


# --- answering -----------------------------------------------------------------------------------


def _data_response(asked: DataRequest, is_head: bool) -> Response:
    media_type, encode = _FORMATS[asked.format]
    headers = {**_HEADERS, "Vary": "Accept-Encoding"}
    if asked.accepts_gzip:
        headers["Content-Encoding"] = "gzip"
    if is_head:
        return StreamingResponse(iter(()), media_type=media_type, headers=headers)
    blocks = asked.served.blocks(asked.start, asked.stop, asked.parameters)
    records = _logged(encode(tt2000, columns) for tt2000, columns in blocks)
    # Read before the status is sent: whether there is any, and whether it can be read.
    first = next(records, None)
    parts: Iterable[bytes] = () if first is None else itertools.chain((first,), records)
    if asked.with_header:
        info = {**asked.served.info(asked.parameters), "format": asked.format}
        parts = itertools.chain((_header_lines(_with_status(info, 1201 if first is None else 1200)),), parts)
    body = _compressed(parts) if asked.accepts_gzip else iter(parts)
    return StreamingResponse(body, media_type=media_type, headers=headers)


def _logged(records: Iterable[bytes]) -> Iterator[bytes]:
    """Say on the server why an answer breaks off: its client only sees that it has no end."""
    started = False
    try:
        for record in records:
            yield record
            started = True
    except InflightError as error:
        if started:
            LOG.error("an answer broke off: %s", error)
        raise


def _header_lines(fields: Mapping[str, Any]) -> bytes:
    return "".join(f"#{line}\n" for line in json.dumps(fields, indent=1).splitlines()).encode()


def _compressed(parts: Iterable[bytes]) -> Iterator[bytes]:
    """Compress as it comes; the fastest level, which takes less time than encoding did."""
    packer = zlib.compressobj(1, wbits=16 + zlib.MAX_WBITS)
    for part in parts:
        if packed := packer.compress(part):
            yield packed
    yield packer.flush()


def _about(collection: Collection, _given: Mapping[str, str]) -> dict[str, Any]:
    stated, first = collection.statement, collection.datasets()[0]
    header = stated.header
    example = first.info(list(first.parameters.values())[:1])
    return {
        "id": "/".join(filter(None, (header.pi_affiliation, stated.mission))) or "inflight",
        "title": f"Releases of {stated.mission or 'a mission'}",
        "contact": ", ".join(filter(None, (header.pi_name, header.pi_affiliation))) or "not stated",
        **({"description": stated.description} if stated.description else {}),
        "dataTest": {
            "name": "the first samples of the first release",
            "query": {
                "dataset": first.id,
                "start": example["sampleStartDate"],
                "stop": example["sampleStopDate"],
                "parameters": ",".join(item["name"] for item in example["parameters"]),
            },
        },
        "x_software": f"inflight {__version__}",
    }


def _capabilities(_collection: Collection, _given: Mapping[str, str]) -> dict[str, Any]:
    return {"outputFormats": list(_FORMATS), "catalogDepthOptions": ["dataset", "all"]}


def _catalog(collection: Collection, given: Mapping[str, str]) -> dict[str, Any]:
    depth = given.get("depth", "dataset")
    if depth not in ("dataset", "all"):
        raise RefusedError(1413, "it is dataset or all")
    items: list[dict[str, Any]] = []
    for served in collection.datasets():
        items.append({"id": served.id, "title": served.title})
        if depth == "all":
            items[-1]["info"] = served.info(list(served.parameters.values()))
    return {"catalog": items}


#: Endpoint that is not about one dataset -> what it says.
_METADATA: Final = {"about": _about, "capabilities": _capabilities, "catalog": _catalog}


def _with_status(fields: Mapping[str, Any], code: int = 1200) -> dict[str, Any]:
    return {"HAPI": VERSION, "status": {"code": code, "message": STATUS[code][1]}, **fields}


def _refusal(refused: RefusedError, headers: Mapping[str, str] | None = None) -> Response:
    message = STATUS[refused.code][1] + (f"; {refused.remark}" if refused.remark else "")
    fields = {"HAPI": VERSION, "status": {"code": refused.code, "message": message}}
    return _json(fields, refused.http, headers)


def _json(fields: Mapping[str, Any], status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    text = json.dumps(fields, ensure_ascii=False)
    return Response(text.encode(), status, {**_HEADERS, **(headers or {})}, media_type="application/json")


def _landing_page(collection: Collection) -> str:
    """Return a page that says what is here and how to ask for it."""
    rows = []
    for served in collection.datasets():
        first, last = served.release.datasets[served.dataset]
        name = html.escape(served.id)
        rows.append(
            f"<tr><td>{name}</td><td>{day_text(first)[:10]}</td><td>{day_text(last)[:10]}</td>"
            f'<td><a href="/hapi/info?dataset={name}">info</a></td></tr>'
        )
    title = html.escape(f"Releases of {collection.statement.mission or 'a mission'}")
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><h1>{title}</h1>"
        f"<p>{html.escape(collection.statement.description)}</p>"
        f"<p>A server of HAPI {VERSION}, for hapiclient, SPEDAS, Autoplot and others: "
        + ", ".join(f'<a href="/hapi/{name}">{name}</a>' for name in ("about", "capabilities", "catalog"))
        + ", info?dataset=ID, data?dataset=ID&amp;start=TIME&amp;stop=TIME.</p>"
        f"<table><tr><th>dataset<th>first day<th>last day<th></tr>{''.join(rows)}</table></html>"
    )
