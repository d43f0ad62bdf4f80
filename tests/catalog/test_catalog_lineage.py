"""Lineage as a graph: both ways to the end, in words, and as a picture whose lines meet its boxes."""

import re
import xml.etree.ElementTree as ET

import pytest
from catalog_cases import days_from, samples, table

from inflight.catalog import Catalog, FileRecord
from inflight.errors import CatalogError
from inflight.time import day_bounds

DAYS = days_from("2005-01-01", 3)
SPAN = day_bounds(DAYS[0])[0], day_bounds(DAYS[-1])[1]


def file_of(day, run):
    return FileRecord(
        instrument="fgm",
        path=f"/in/fgm_{day}.csv",
        sha256=f"{str(day)[-1] * 64}",
        size=1,
        mtime_ns=1,
        days=(str(day),),
        report={},
        run=run.id,
    )


@pytest.fixture(scope="module")
def chain(tmp_path_factory) -> Catalog:
    """Three days from file to release; the product of the last day was made anew since. It is only read."""
    catalog = Catalog(tmp_path_factory.mktemp("lineage"))
    with catalog.run("ingest") as run:
        records = [file_of(day, run) for day in DAYS]
        catalog.record_files(run, records)
        raw = [
            run.stage("l1/fgm", samples(day, step_s=3600), day=day, parents=[f"file:{one.sha256}"])
            for day, one in zip(DAYS, records, strict=True)
        ]
        run.publish()
    catalog.save_model("probe", "effects: []")
    context = catalog.save_context("mission: probe", "probe", 1, {})
    with catalog.run("reprocess", context=context) as run:
        made = run.stage_table("main-window", table(), start=SPAN[0], end=SPAN[1], parents=raw)
        for day, one in zip(DAYS, raw, strict=True):
            run.stage("l2/field", samples(day, step_s=3600), day=day, parents=[one, f"table:{made}"])
        run.publish(certify=[(made, *SPAN, None)])
    catalog.release("1.0", datasets=["l2/*"])
    with catalog.run("reprocess", context=context) as run:
        parents = [raw[2], f"table:{made}"]
        run.stage("l2/field", samples(DAYS[2], step_s=3600, seed=1), day=DAYS[2], parents=parents)
        run.publish()
    return catalog


def test_from_a_product_to_its_files_and_from_a_file_to_the_releases(chain):
    text = chain.lineage_graph("l2/field@2005-01-02").text()
    assert text.splitlines() == [
        "l2/field: 2005-01-02 v01.00",
        "made from",
        "  archive l1/fgm: 2005-01-02 v01.00 (of 3)",
        "    delivered files fgm: fgm_2005-01-02.csv (of 3)",
        "  calibration table main-window: table 1, 2005-01-01 to 2005-01-03",
        "    archive l1/fgm: 3 days, 2005-01-01 to 2005-01-03",
        "      delivered files fgm: 3 files, 2005-01-01 to 2005-01-03",
        f"    context: mission file with model probe 1 ({chain.runs('reprocess')[0].context[:8]})",
        "      model probe: version 1",
        f"  context: mission file with model probe 1 ({chain.runs('reprocess')[0].context[:8]}) (see above)",
        "made from it",
        "  release: 1.0 (preliminary)",
    ]
    down = chain.lineage_graph("fgm_2005-01-03.csv", "down")
    assert {(node.heading, node.text) for node in down.nodes} == {
        ("delivered files fgm", "fgm_2005-01-03.csv"),
        ("archive l1/fgm", "2005-01-03 v01.00"),
        ("calibration table main-window", "table 1, 2005-01-01 to 2005-01-03"),
        # The table took this file, too: every product made with it.
        ("product l2/field", "4 revisions of 3 days, 2005-01-01 to 2005-01-03; 3 in use"),
        ("release", "1.0 (preliminary)"),
    }


@pytest.mark.parametrize(
    ("named", "name"),
    [
        ("l2/field", "l2/field: 3 days, 2005-01-01 to 2005-01-03"),
        ("day:6", "l2/field: 2005-01-03 v01.00, not in use any more"),
        ("main-window", "main-window: table 1, 2005-01-01 to 2005-01-03"),
        ("table:1", "main-window: table 1, 2005-01-01 to 2005-01-03"),
        ("in/fgm_2005-01-01.csv", "fgm: fgm_2005-01-01.csv"),
        ("model:1", "probe: version 1"),
        ("release:1.0", "release: 1.0 (preliminary)"),
    ],
)
def test_things_are_asked_for_as_a_person_writes_them(chain, named, name):
    assert chain.lineage_graph(named).name == name


@pytest.mark.parametrize(
    "named", ["l2/field@2006-01-01", "main-window:7", "day:99", "m_2005-01-01.csv", "release:2.0"]
)
def test_what_is_not_there_has_no_lineage(chain, named):
    with pytest.raises(CatalogError, match="the catalog knows no"):
        chain.lineage_graph(named)


def test_the_picture_joins_the_boxes(chain):
    graph = chain.lineage_graph("table:1")
    picture = ET.fromstring(graph.svg())
    space = "{http://www.w3.org/2000/svg}"
    boxes = {}
    for group in picture.iter(f"{space}g"):
        x, y = map(float, re.findall(r"[\d.]+", group.get("transform")))
        frame = group.find(f"{space}rect")
        sides = x, x + float(frame.get("width")), y + float(frame.get("height")) / 2
        # The first line under the mouse is the heading.
        boxes[group.find(f"{space}title").text.splitlines()[0]] = sides
    assert set(boxes) == {node.heading for node in graph.nodes}
    assert len({(left, middle) for left, _, middle in boxes.values()}) == len(boxes)
    heading = {node.key: node.heading for node in graph.nodes}
    expected = {(heading[link.parent], heading[link.child]) for link in graph.links}
    joined = set()
    for curve in picture.findall(f"{space}path"):
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", curve.get("d"))]
        start, end = numbers[:2], numbers[-2:]
        (parent,) = [key for key, (_, right, middle) in boxes.items() if [right, middle] == start]
        (child,) = [key for key, (left, _, middle) in boxes.items() if [left - 6, middle] == end]
        assert boxes[parent][1] < boxes[child][0]
        joined.add((parent, child))
    assert joined == expected
