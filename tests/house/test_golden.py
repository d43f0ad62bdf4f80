"""The golden record finds what differs between two folders, and only that."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from benchmarks.golden.compare import DIFFERENT, IDENTICAL, WITHIN, Tolerances, compare_case, compare_records
from benchmarks.golden.export import write

ROOT = Path(__file__).parents[2]
ID = "889cbe4f-b65d-485b-ba4e-8b6ede27d131"
VERDICT = {
    "run": "20240301T101112-diagnose-0a1b2c3d",
    "verdict": "FOUND",
    "sentence": "A camera effect, 0.0225 nT rms.",
    "effects": [{"name": "camera", "coefficients": {"value": 1.5, "sigma": 0.2}}],
    "residual": {"before_nT": 0.0991, "after_nT": 0.0905, "samples": 1200},
}
PAGE = """<html><head><script>var made_at = {stamp};</script></head><body><h1>tiny</h1>
<table><tr><td>offset[x]</td><td>{value}</td></tr></table><div id="{uuid}"></div>
<script>const docs_json = '{document}';
</script></body></html>
"""


def product(**changes) -> xr.Dataset:
    times = np.arange(100, dtype=np.int64)
    field = np.round(np.random.default_rng(1).normal(0, 30_000, (100, 3)), 4)
    data = xr.Dataset(
        {
            "field_nec": (("time", "axis"), field, {"units": "nT"}),
            "flag": ("time", np.zeros(100, dtype=np.uint32)),
            "latitude": ("time", np.linspace(-80.0, 80.0, 100), {"units": "deg"}),
        },
        coords={"axis": ["x", "y", "z"], "tt2000": ("time", times)},
        attrs={"mission": "tiny"},
    )
    return data.assign(changes)


def table(shift: float = 0.0) -> xr.Dataset:
    sigma = np.array([[0.02, 1e-6]])
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), np.array([[20.0, 1.0002]]) + shift * sigma),
            "sigma": (("interval", "parameter"), sigma),
            "covariance": (("interval", "parameter", "other"), sigma[..., None] ** 2 * np.eye(2)),
            "determined": (("interval", "parameter"), np.array([[True, False]])),
        },
        coords={"parameter": ["offset[x]", "scale_factor[x]"]},
        attrs={"model": "70edf9274318e590183c8b9d7c0469a7"},
    )


def page(
    value: str = "20.000", drawn: float = 1.0, uuid: str = "889cbe4f-b65d-485b-ba4e-8b6ede27d131"
) -> str:
    document = {uuid: {"title": "Bokeh Application", "id": "p1", "data": {"map": [["y", [0.0, drawn]]]}}}
    return PAGE.format(stamp=uuid, value=value, uuid=uuid, document=json.dumps(document))


def record(
    folder: Path, verdict=None, data: xr.Dataset | None = None, shift: float = 0.0, html: str = ""
) -> Path:
    case = folder / "tiny"
    for name in ("steps", "pages", "data/end"):
        (case / name).mkdir(parents=True)
    (case / "case.json").write_text(json.dumps({"steps": ["diagnose"]}), encoding="utf-8")
    told = {"exit": 0, "printed": verdict or VERDICT}
    (case / "steps" / "00-diagnose.json").write_text(json.dumps(told), encoding="utf-8")
    (case / "pages" / "report.html").write_text(html or page(), encoding="utf-8")
    write(case / "data" / "end" / "l2_field.npz", product() if data is None else data)
    write(case / "data" / "end" / "tables_main-window.0.npz", table(shift))
    return case


def changed(path: str, value) -> dict:
    told = json.loads(json.dumps(VERDICT))
    *inside, last = path.split(".")
    place = told
    for key in inside:
        place = place[int(key) if key.isdigit() else key]
    place[last] = value
    return told


@pytest.fixture
def differing(tmp_path):
    """Compare a record with one that was made with changes; return what is not identical, by its name."""
    before = record(tmp_path / "before")

    def compare(**changes):
        items = compare_case(before, record(tmp_path / "after", **changes), Tolerances())
        return {item.what: item for item in items if item.level != IDENTICAL}

    return compare


def test_two_records_of_the_same_are_identical_whatever_run_and_page_are_called(differing):
    told = VERDICT | {"run": "20240302T000000-diagnose-ffffffff"}
    assert not differing(verdict=told, html=page(uuid="2c1b8761-fcdd-48c0-b4cf-bfd06aaa0e84"))


def test_a_field_that_moved_by_a_picotesla_is_different(differing):
    field = product()["field_nec"].copy()
    field[7, 1] += 1e-3
    (item,) = differing(data=product(field_nec=field)).values()
    assert item.level == DIFFERENT
    assert item.largest[1].startswith("0.001 nT (1 of 300 differ, 1 beyond, most at [7, 1])")


def test_a_field_that_moved_by_its_rounding_is_within_tolerance(differing):
    field = product()["field_nec"].copy()
    field[7, 1] += 1e-4
    (item,) = differing(data=product(field_nec=field)).values()
    assert item.level == WITHIN


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_field_that_is_lost_is_different(differing, lost):
    field = product()["field_nec"].copy()
    field[7, 1] = lost
    (item,) = differing(data=product(field_nec=field)).values()
    assert item.level == DIFFERENT


@pytest.mark.parametrize("name", ["flag", "tt2000"])
def test_a_flag_or_a_time_that_changed_is_different(differing, name):
    (item,) = differing(data=product(**{name: product()[name] + 1})).values()
    assert item.level == DIFFERENT


@pytest.mark.parametrize(("shift", "level"), [(5e-4, WITHIN), (2e-3, DIFFERENT)])
def test_parameters_are_held_against_their_sigma(differing, shift, level):
    (item,) = differing(shift=shift).values()
    assert item.what == "data/end/tables_main-window.0.npz"
    assert item.level == level


@pytest.mark.parametrize(
    ("path", "value", "level"),
    [
        ("sentence", "A battery effect, 0.0225 nT rms.", DIFFERENT),
        ("verdict", "CONFOUNDED", DIFFERENT),
        ("residual.samples", 1201, DIFFERENT),
        ("residual.after_nT", 0.0905 * (1 + 1e-5), DIFFERENT),
        ("residual.after_nT", 0.0905 * (1 + 1e-7), WITHIN),
        ("residual.after_nT", None, DIFFERENT),
        ("effects.0.coefficients.value", 1.5 + 1e-4, WITHIN),
        ("effects.0.coefficients.value", 1.5 + 1e-3, DIFFERENT),
        ("effects", [], DIFFERENT),
        ("left_out", {}, WITHIN),
    ],
)
def test_what_a_verb_printed_is_compared(differing, path, value, level):
    (item,) = differing(verdict=changed(path, value)).values()
    assert item.what == "steps/00-diagnose.json"
    assert item.level == level


def test_a_key_that_is_gone_is_different(differing):
    told = {key: value for key, value in VERDICT.items() if key != "residual"}
    (item,) = differing(verdict=told).values()
    assert item.level == DIFFERENT


@pytest.mark.parametrize(
    ("html", "level"),
    [
        (page("20.001"), WITHIN),
        (page("20.002"), DIFFERENT),
        (page("20.00"), DIFFERENT),
        (page(drawn=1.1), DIFFERENT),
    ],
)
def test_pages_are_compared_by_their_text_and_by_what_is_drawn(differing, html, level):
    (item,) = differing(html=html).values()
    assert item.what == "pages/report.html"
    assert item.level == level


def test_other_commands_are_a_difference_of_the_records(tmp_path):
    before, after = record(tmp_path / "before"), record(tmp_path / "after")
    (after / "case.json").write_text(json.dumps({"steps": ["auto"]}), encoding="utf-8")
    assert [item.what for item in compare_case(before, after, Tolerances()) if item.differences] == [
        "case.json"
    ]


def test_a_file_that_only_one_record_has_is_a_difference(tmp_path):
    before, after = record(tmp_path / "before"), record(tmp_path / "after")
    (after / "pages" / "report.html").unlink()
    assert [item.level for item in compare_case(before, after, Tolerances())].count(DIFFERENT) == 1


def test_records_without_a_common_case_are_no_proof(tmp_path, capsys):
    record(tmp_path / "before")
    assert compare_records(tmp_path / "before", tmp_path / "empty", None, Tolerances()) == 1
    assert "not in both records" in capsys.readouterr().out


def test_the_command_ends_with_one_when_something_differs(tmp_path):
    record(tmp_path / "before")
    record(tmp_path / "same")
    record(tmp_path / "other", verdict=changed("verdict", "CONFOUNDED"))
    ends = {}
    for name in ("same", "other"):
        words = ["-m", "benchmarks.golden", "compare", tmp_path / "before", tmp_path / name]
        done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False)
        ends[name] = done.returncode, done.stdout
    assert ends["same"][0] == 0
    assert "5 identical" in ends["same"][1]
    assert ends["other"][0] == 1
    assert "printed.verdict: 'FOUND' is now 'CONFOUNDED'" in ends["other"][1]
