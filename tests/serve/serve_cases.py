"""A small workspace with releases, and what a client makes of the answers."""

from __future__ import annotations

import asyncio
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlencode

import numpy as np
import pandas as pd
import xarray as xr
from probe_mission import PROBE_YAML

from inflight.catalog import Catalog, DayData, FileRecord, MissionStatement, write_segment
from inflight.mission import Mission
from inflight.serve import Collection
from inflight.time import SECOND, day_bounds

MISSION = Mission.parse(PROBE_YAML + "  doi: 10.1234/probe\n  link: https://example.org/probe\n")
#: The second one ends with a leap second, the fourth was not delivered.
DAYS = [np.datetime64(text) for text in ("2005-12-30", "2005-12-31", "2006-01-01", "2006-01-03")]
ID = "probe/1.0/l2/field"
SPAN = {"start": "2005-12-30Z", "stop": "2006-01-04Z"}
_DELIVERED = "a" * 64


def samples(day: np.datetime64) -> xr.Dataset:
    """A day of a product: 600 s apart and jittered, and every half second around its end."""
    start, end = day_bounds(day)
    rng = np.random.default_rng(abs(int(day.astype(int))))
    coarse = np.arange(start, end - 10 * SECOND, 600 * SECOND) + rng.integers(0, 10**9, 144)
    times = np.concatenate([coarse, np.arange(end - 4 * SECOND, end, SECOND // 2)])
    count = times.size
    field = np.round(rng.normal(0, 30000, (count, 3)), 2)
    field[::17, 1] = np.nan
    return xr.Dataset(
        {
            "tt2000": ("time", times),
            "temperature": ("time", rng.normal(20, 1e-7, count), {"units": "degC"}),
            "field_nec": (
                ("time", "axis"),
                field,
                {"units": "nT", "resolution": 0.01, "frame": "nec", "long_name": "calibrated field"},
            ),
            "field_sensor": (("time", "axis"), -field, {"units": "nT", "frame": "sensor"}),
            "uncertainty": (("time", "axis"), abs(field) * 1e-5, {"units": "nT", "frame": "sensor"}),
            "flag": ("time", rng.integers(0, 2**32, count).astype(np.uint32)),
            "mode": ("time", np.array(["plain", 'a, "quoted" one', "nan", "Größe"])[np.arange(count) % 4]),
            "counter": ("time", np.arange(count, dtype=np.int64) * 10**10),
            "step": ("time", np.arange(count, dtype=np.int16) - 50),
            "small": ("time", np.linspace(0, 1, count, dtype=np.float32)),
            "tensor": (("time", "axis", "other"), rng.normal(size=(count, 3, 2))),
            "rotation": (("axis", "axis2"), np.eye(3)),
        },
        coords={"axis": [0, 1, 2]},
        attrs={"mission": "probe"},
    )


def make_workspace(root: Path) -> Path:
    """Make a workspace of a probe with an archive and a product, and release 1.0 of both."""
    root.mkdir()
    (root / "mission.yaml").write_text(MISSION.text, "utf-8")
    catalog = Catalog(root)
    parents = (f"file:{_DELIVERED}",)
    with catalog.run("ingest") as run:
        file = FileRecord(
            instrument="fgm",
            path="a.cdf",
            sha256=_DELIVERED,
            size=1,
            mtime_ns=1,
            days=(),
            report={},
            run=run.id,
        )
        catalog.record_files(run, [file])
        raw = [DayData(day, samples(day)[["tt2000", "field_sensor"]], str(day), parents) for day in DAYS]
        run.attach(write_segment(root, run.id, "l1/fgm", raw))
        run.record("l1/fgm", np.datetime64("2006-01-02"), "no_work", "no_work", "nothing delivered")
        run.publish()
    with catalog.run("reprocess") as run:
        run.record("l2/field", np.datetime64("2006-01-02"), "no_work", "no_work", "nothing delivered")
        early = [DayData(day, samples(day), str(day), parents) for day in DAYS[:2]]
        run.attach(write_segment(root, run.id, "l2/field", early))
        # The model gained an effect, and lost what counted steps.
        late = [
            DayData(
                day,
                samples(day)
                .assign(correction_heater=("time", samples(day)["temperature"].values))
                .drop_vars("step"),
                str(day),
                parents,
            )
            for day in DAYS[2:]
        ]
        run.attach(write_segment(root, run.id, "l2/field", late))
        blocks = xr.Dataset({"start": ("block", np.array([day_bounds(DAYS[0])[0]])), "rms": ("block", [1.0])})
        run.stage("l2/blocks", blocks, day=DAYS[0], parents=parents)
        run.publish()
    catalog.release("1.0", mission=MISSION)
    return root


def collection_of(root: Path) -> Collection:
    return Collection(Catalog(root), MissionStatement.of(MISSION))


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status_code: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def text(self) -> str:
        return self.content.decode()

    def json(self) -> Any:
        return json.loads(self.content)


class Client:
    """Asks an application as a server of ASGI does, without a socket."""

    def __init__(self, app: Any) -> None:
        self._app = app

    def request(
        self,
        method: str,
        path: str,
        params: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
        on_body: Callable[[bytes], object] = lambda body: None,
    ) -> Answer:
        """Carry out one request; `on_body` is called with each part of the body as it is sent."""
        path, _, query = path.partition("?")
        told: dict[str, Any] = {}
        parts: list[bytes] = []

        async def receive() -> dict[str, Any]:
            await asyncio.sleep(60)
            return {"type": "http.disconnect"}

        async def send(message: dict[str, Any]) -> None:
            if message["type"] == "http.response.start":
                told.update(message)
            elif body := message.get("body"):
                parts.append(body)
                on_body(body)

        scope = {
            "type": "http",
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "method": method,
            "scheme": "http",
            "path": unquote(path),
            "raw_path": path.encode(),
            "query_string": (urlencode(params) if params else query).encode(),
            "root_path": "",
            "headers": [(name.lower().encode(), value.encode()) for name, value in (headers or {}).items()],
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 80),
        }
        asyncio.run(self._app(scope, receive, send))
        got = {name.decode(): value.decode() for name, value in told["headers"]}
        # A server sends no body in answer to HEAD.
        return Answer(told["status"], got, b"" if method == "HEAD" else b"".join(parts))

    def get(self, path: str, params: Mapping[str, str] | None = None, **more: Any) -> Answer:
        return self.request("GET", path, params, **more)

    def head(self, path: str, params: Mapping[str, str] | None = None) -> Answer:
        return self.request("HEAD", path, params)


def dtype_of(info: dict) -> np.dtype:
    """The dtype of a binary record, as the standard derives it from ``info``."""
    kinds = {"double": "<f8", "integer": "<i4"}
    return np.dtype(
        [
            (item["name"], kinds.get(item["type"], f"S{item.get('length')}"), tuple(item.get("size", ())))
            for item in info["parameters"]
        ]
    )


def from_binary(content: bytes, info: dict) -> np.ndarray:
    return np.frombuffer(content, dtype_of(info))


def from_csv(text: str, info: dict) -> np.ndarray:
    """Read CSV into the same records as the binary form, by another library than wrote it."""
    dtype = dtype_of(info)
    table = pd.read_csv(io.StringIO(text), header=None, keep_default_na=False, dtype=str)
    records, column = np.empty(len(table), dtype), 0
    for name in dtype.names:
        shape = dtype[name].shape
        width = int(np.prod(shape, dtype=int))
        cells = table.iloc[:, column : column + width].to_numpy(str)
        column += width
        cells = np.char.encode(cells, "utf-8") if dtype[name].base.kind == "S" else cells
        records[name] = cells.astype(dtype[name].base).reshape(len(table), *shape)
    assert column == table.shape[1]
    return records


def split_header(content: bytes) -> tuple[dict, bytes]:
    """Return the header that ``include=header`` puts before the data, and the data."""
    lines = []
    while content.startswith(b"#"):
        line, _, content = content.partition(b"\n")
        lines.append(line[1:])
    return json.loads(b"\n".join(lines)), content
