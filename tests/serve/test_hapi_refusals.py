"""Bad requests: each has its code, none a traceback, and nothing that was sent is repeated."""

import json
import logging
import shutil

import pytest
from serve_cases import ID, SPAN, Client, collection_of

from inflight.errors import IntegrityError
from inflight.serve import make_app

DATA = f"data?dataset={ID}&start=2005-12-30&stop=2006-01-01"
#: What is asked for below /hapi/ -> HTTP status and code.
BAD = [
    # Endpoints and names
    ("datasets", 400, 1400),
    ("data/", 400, 1400),
    ("info/extra?dataset=x", 400, 1400),
    ("..%2f..%2fetc%2fpasswd", 400, 1400),
    ("Catalog", 400, 1400),
    ("catalog?all=yes", 400, 1401),
    ("capabilities?format=csv", 400, 1401),
    ("about?x=1", 400, 1401),
    ("?x=1", 400, 1401),
    (f"info?dataset={ID}&start=2005-12-30", 400, 1401),
    (f"info?Dataset={ID}", 400, 1401),
    (f"{DATA}&averagingInterval=5s", 400, 1401),
    (f"{DATA}&x_format=csv", 400, 1401),
    (f"{DATA}&=", 400, 1401),
    (f"{DATA}&depth=all", 400, 1401),
    ("catalog?depth=ALL", 400, 1413),
    ("catalog?depth=", 400, 1413),
    # The dataset
    ("info", 400, 1400),
    ("info?dataset=", 400, 1400),
    ("data?start=2005-12-30&stop=2006-01-01", 400, 1400),
    (f"info?dataset={ID}&dataset={ID}", 400, 1400),
    (f"info?dataset={ID}&id={ID}", 400, 1400),
    ("info?dataset=probe/2.0/l2/field", 404, 1406),
    ("info?dataset=probe/1.0/l2/blocks", 404, 1406),
    ("info?dataset=../../etc/passwd", 404, 1406),
    ("info?dataset=<script>alert(1)</script>", 404, 1406),
    ("info?dataset=%ff%00", 404, 1406),
    ("data?dataset=x&start=nonsense&stop=nonsense", 404, 1406),
    # Parameters
    (f"info?dataset={ID}&parameters=nothing", 404, 1407),
    (f"info?dataset={ID}&parameters=flag,", 404, 1407),
    (f"info?dataset={ID}&parameters=FLAG", 404, 1407),
    (f"{DATA}&parameters=tt2000", 404, 1407),
    (f"{DATA}&parameters=rotation", 404, 1407),
    (f"{DATA}&parameters=flag,field_nec", 400, 1411),
    (f"{DATA}&parameters=flag,flag", 400, 1411),
    (f"{DATA}&parameters=flag,Time", 400, 1411),
    (f"info?dataset={ID}&parameters=Time,Time", 400, 1411),
    # Times
    (f"data?dataset={ID}&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-30", 400, 1403),
    (f"data?dataset={ID}&start=&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=30.12.2005&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-30T12:00:00%2B01:00&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-30&stop=2006-01-32", 400, 1403),
    (f"data?dataset={ID}&start=2005-12-30&stop=2005-366", 400, 1403),
    (f"data?dataset={ID}&start=2005-12-30T23:59:60Z&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-30T25Z&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-30T&stop=2006-01-01", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-30&stop={'9' * 5000}", 400, 1403),
    (f"data?dataset={ID}&start=2005-12-30T00:00:00.{'9' * 5000}&stop=2006", 400, 1402),
    (f"data?dataset={ID}&start=2005-12-31&stop=2005-12-31", 400, 1404),
    (f"data?dataset={ID}&start=2006-01-01&stop=2005-12-31", 400, 1404),
    (f"data?dataset={ID}&start=2005-12-29T23:59:59.999999999Z&stop=2006-01-01", 400, 1405),
    (f"data?dataset={ID}&start=2005-12-30&stop=2006-01-04T00:00:00.000000001Z", 400, 1405),
    (f"data?dataset={ID}&start=0001-01-01&stop=9999-12-31", 400, 1405),
    # Formats
    (f"{DATA}&format=json", 400, 1409),
    (f"{DATA}&format=CSV", 400, 1409),
    (f"{DATA}&format=", 400, 1409),
    (f"{DATA}&include=headers", 400, 1410),
    (f"{DATA}&include=", 400, 1410),
    (f"{DATA}&resolve_references=maybe", 400, 1412),
]


def test_there_are_fifty_bad_requests_of_every_code():
    assert len({text for text, *_ in BAD}) == len(BAD) >= 50
    assert {code for *_, code in BAD} == {*range(1400, 1408), *range(1409, 1414)}


@pytest.mark.parametrize(("text", "http", "code"), BAD, ids=[f"{code}-{text[:60]}" for text, _, code in BAD])
def test_a_bad_request_has_its_code_and_no_traceback(client, caplog, text, http, code):
    with caplog.at_level(logging.DEBUG, "inflight.serve"):
        answer = client.get(f"/hapi/{text}")
    assert answer.status_code == http
    assert answer.headers["content-type"] == "application/json"
    told = answer.json()
    assert set(told) == {"HAPI", "status"}
    assert told["HAPI"] == "3.2"
    assert told["status"]["code"] == code
    assert told["status"]["message"].startswith("Bad request - ")
    assert caplog.records == []
    for word in ("nonsense", "script", "passwd", "averaging", "Traceback", "99999"):
        assert word not in answer.text


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
@pytest.mark.parametrize("path", ["/hapi/data", "/hapi", "/"])
def test_nothing_but_get_and_head_is_answered(client, method, path):
    answer = client.request(method, path)
    assert answer.status_code == 405
    assert answer.headers["allow"] == "GET, HEAD"
    assert answer.json()["status"]["code"] == 1400


def test_what_is_outside_is_not_found(client):
    answer = client.get("/catalog.db")
    assert answer.status_code == 404
    assert answer.json()["status"]["code"] == 1400


def chunks_of_temperature(root):
    chunks = list(root.glob("stores/*/l2.field-20060101*/temperature/c.*"))
    assert chunks
    return chunks


def test_what_cannot_be_read_is_an_error_of_the_server_that_tells_no_path(workspace, tmp_path, caplog):
    root = tmp_path / "probe"
    shutil.copytree(workspace, root)
    for chunk in chunks_of_temperature(root):
        chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    client = Client(make_app(collection_of(root)))
    query = {"dataset": ID, "start": "2006-01-01", "stop": "2006-01-02"}
    with caplog.at_level(logging.ERROR, "inflight.serve"):
        answer = client.get("/hapi/data", query)
    assert answer.status_code == 500
    assert answer.json()["status"]["code"] == 1500
    assert str(tmp_path) not in answer.text
    assert "content is not what was written" in caplog.text
    # What is whole is served.
    assert client.get("/hapi/data", {**query, "parameters": "flag"}).status_code == 200
    assert client.get("/hapi/catalog").status_code == 200


def test_a_defect_is_an_error_of_the_server(workspace, monkeypatch, caplog):
    collection = collection_of(workspace)
    monkeypatch.setattr(type(collection), "datasets", lambda self: 1 / 0)
    answer = Client(make_app(collection)).get("/hapi/catalog")
    assert answer.status_code == 500
    assert json.loads(answer.text)["status"] == {"code": 1500, "message": "Internal server error"}
    assert "ZeroDivisionError" in caplog.text


def test_damage_met_on_the_way_breaks_the_answer_off(workspace, tmp_path, caplog):
    root = tmp_path / "probe"
    shutil.copytree(workspace, root)
    for chunk in chunks_of_temperature(root):
        chunk.unlink()
    client = Client(make_app(collection_of(root)))
    # The status is sent by then: only an answer without its end tells the client.
    with caplog.at_level(logging.ERROR, "inflight.serve"), pytest.raises(IntegrityError):
        client.get("/hapi/data", {"dataset": ID, **SPAN})
    assert [record.message.partition(":")[0] for record in caplog.records] == ["an answer broke off"]
