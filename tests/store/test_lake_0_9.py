"""A lake that release 0.9.0 wrote is read by this one, and what is made of it stays what it was.

The lake is in `lake_0_9`: the record tables of three simulated vehicles on six days, by the code of 0.9.0 (README.md
there). `expected` beside it holds what was made of them before records had edges in place of pairs.

What is compared: every column that the expected rows have (new columns may join them), every word and number of pages
and files. Left out are stamps of time, work keys and this release's number, which every run or release has of its own,
and of pages the markup, the style and the script. Numbers may differ in what another machine's linear algebra rounds
otherwise; run this file as a script with `--exact` to see every digit that differs, with `--write` to accept what is
made today.
"""

import contextlib
import io
import json
import math
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from jobs.cli import main
from pipeline.config import load_fleet
from pipeline.errors import ContractError
from pipeline.export.files import SIDE_FILE
from pipeline.export.formats import format_named
from pipeline.report.stage import write_day_page
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding
from schemas.states import STATES, StateRow
from schemas.versions import CODE_VERSION

HERE = Path(__file__).resolve().parent / "lake_0_9"
EXPECTED = HERE / "expected"
TABLES = ("calibrations", "drift", "outcomes", "service_events", "states")
# All but Foxglove's, which shows images. The side file with the provenance is the same of all: one of them is kept.
FORMATS = (
    "ros2", "tf-static", "urdf", "xacro", "autoware", "nuscenes", "t4", "kalibr", "kitti", "opencv",
)  # fmt: skip
# Formats, vehicle and options: a state of which a pair has no day, a day after a knock, a held day.
EXPORTED = {
    "state": (FORMATS, "vehicle-1"),
    "day": (("autoware", "urdf", "nuscenes", "tf-static"), "vehicle-3", "--day", "2026-03-07"),
    "forced": (("autoware", "kitti"), "vehicle-1", "--day", "2026-03-04", "--force", "--unchecked"),
}
_WITH_SIDE_FILE = "urdf"
DAYS = (("vehicle-2", "2026-03-06"), ("vehicle-1", "2026-03-04"), ("vehicle-3", "2026-03-03"))
_OF_A_RUN = ("work_key", "recorded_at", "asserted_at", "inputs")
_RETIRED = ("trio",)  # columns that are no more
_NUMBER = re.compile(r"[-+]?\d+\.\d+(?:[eE][-+]?\d+)?|[-+]?\d+[eE][-+]?\d+")
_STAMP = re.compile(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z")
_KEY = re.compile(r"(?<!\.)\b[0-9a-f]{20}\b")  # no decimals of a number


def told(*arguments):
    """Exit code and what a command prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = main([str(a) for a in arguments])
    return code, out.getvalue()


def plain(text):
    """A text without what each run and each release has of its own."""
    return _KEY.sub("KEY", _STAMP.sub("STAMP", text.replace(CODE_VERSION, "VERSION")))


def rows_of(text):
    """Rows of `--json`, one to a line, less what tells when and by which work they were written, and what is null."""
    rows = [
        {n: v for n, v in row.items() if v is not None and n not in _OF_A_RUN} for row in json.loads(text)
    ]
    return "".join(json.dumps(row) + "\n" for row in rows)


def words_of(html):
    """What a page says and draws: its data, words and curves, without markup, style and script."""
    data = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', html, re.DOTALL)
    shown = re.sub(r"<(style|script)\b.*?</\1>", "", html, flags=re.DOTALL)
    curves = re.findall(r'\b(?:d|points)="([^"]*)"', shown)
    lines = [line.strip() for line in re.sub(r"<[^>]*>", "\n", shown).splitlines()]
    return "\n".join(plain(part) for part in (*data, *filter(None, lines), *curves)) + "\n"


def everything(lake, folder):
    """All that is compared, by file name; the audit is what today's code makes of the records."""
    found = {
        "drift_of_0_9.jsonl": rows_of(told("show", "drift", "--current", "--json", "--lake", lake)[1]),
        "states_of_0_9.jsonl": rows_of(told("state", "--json", "--lake", lake)[1]),
        "records_of_a_day.jsonl": rows_of(
            told(
                "show",
                "calibrations",
                "--json",
                "--lake",
                lake,
                "--vehicle",
                "vehicle-2",
                "--day",
                "2026-03-05",
            )[1]
        ),
        "events.jsonl": rows_of(told("show", "service_events", "--json", "--lake", lake)[1]),
    }
    page = folder / "fleet.html"
    audit = told("audit", "--fleet", HERE / "fleet.toml", "--lake", lake, "--report", page)[1]
    summary = json.loads(audit.splitlines()[-1])
    summary["outputs"] = [Path(p).relative_to(folder).as_posix() for p in summary["outputs"]]
    summary.pop("report")
    found["audit.txt"] = plain(json.dumps(summary, indent=1).replace(str(lake), "LAKE")) + "\n"
    found["drift.jsonl"] = rows_of(told("show", "drift", "--current", "--json", "--lake", lake)[1])
    found["states.jsonl"] = rows_of(told("state", "--json", "--lake", lake)[1])
    found["status.txt"] = plain(told("status", "--lake", lake, "--json")[1].replace(str(lake), "LAKE"))
    found["fleet_page.txt"] = words_of(page.read_text().replace(str(lake), "LAKE"))
    fleet = load_fleet(HERE / "fleet.toml")
    for vehicle, day in DAYS:
        drawn = write_day_page(Lake.existing(lake), Partition(vehicle, day), fleet, folder / "day.html")
        found[f"day_{vehicle}_{day}.txt"] = words_of(drawn.read_text().replace(str(lake), "LAKE"))
    sides = ("2026-03-05", "2026-03-07")
    found["compare.json"] = told("compare", *sides, "--lake", lake, "--vehicle", "vehicle-2", "--json")[1]
    return found | {f"export_{name}.txt": exported(lake, folder, *rest) for name, rest in EXPORTED.items()}


def exported(lake, folder, formats, vehicle, *rest):
    """Files of several formats, one after the other, and what the command says of each."""
    texts = []
    for form in formats:
        out = folder / vehicle / form
        code, said = told("export", form, "--lake", lake, "--vehicle", vehicle, "--out", out, *rest)
        texts.append(f"=== {form}: exit {code}\n{said.replace(str(folder), 'OUT')}")
        files = [f for f in sorted(out.rglob("*.*")) if f.is_file()] if out.is_dir() else []
        kept = [f for f in files if form == _WITH_SIDE_FILE or not f.name.endswith(SIDE_FILE)]
        texts += [f"--- {f.relative_to(out).as_posix()}\n{_content(form, f)}" for f in kept]
        shutil.rmtree(out, ignore_errors=True)
    return plain("\n".join(texts)) + "\n"


def _content(form, file):
    """Text of a file, or of a binary one the transforms that it holds."""
    content = file.read_bytes()
    try:
        return content.decode()
    except UnicodeDecodeError:
        tree = format_named(form).tree({file.name: content})
        return "".join(f"{p} {c} {tree.lookup(p, c).tolist()}\n" for c, p in sorted(tree.edges.items()))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return everything_of_a_copy(tmp_path_factory.mktemp("lake_0_9"))


def everything_of_a_copy(folder):
    for table in TABLES:
        shutil.copytree(HERE / table, folder / "lake" / table)
    (folder / "out").mkdir()
    return everything(folder / "lake", folder / "out")


def differences(found, expected, relative, *, is_rows):
    """Lines that differ by more than the last digits of their numbers; of rows, in columns that are expected."""
    if len(found) != len(expected):
        yield f"{len(found)} lines, expected {len(expected)}"
    for number, (new, old) in enumerate(zip(found, expected, strict=False), start=1):
        if is_rows:
            was = {n: v for n, v in json.loads(old).items() if n not in _RETIRED}
            new, old = json.dumps({n: json.loads(new).get(n) for n in was}), json.dumps(was)  # noqa: PLW2901
        if _NUMBER.sub("#", new) != _NUMBER.sub("#", old) or not all(
            math.isclose(float(a), float(b), rel_tol=relative, abs_tol=relative)
            for a, b in zip(_NUMBER.findall(new), _NUMBER.findall(old), strict=True)
        ):
            yield f"line {number}: {new[:2000]!r}, expected {old[:2000]!r}"


def compared(found, name, relative):
    expected = (EXPECTED / name).read_text().splitlines()
    return list(differences(found[name].splitlines(), expected, relative, is_rows=name.endswith(".jsonl")))


@pytest.mark.parametrize("name", sorted(p.name for p in EXPECTED.glob("*.*")))
def test_what_is_made_of_a_lake_of_0_9_is_what_it_was(made, name):
    assert compared(made, name, 1e-9)[:3] == []


def test_all_that_is_made_is_compared(made):
    assert sorted(made) == sorted(p.name for p in EXPECTED.glob("*.*"))


def test_a_number_a_word_and_a_row_that_changed_are_seen():
    row, line = '{"pair": "camera_lidar", "qw": 0.5, "reason": "no change"}', "moved by 1.02 deg"
    assert not list(differences([row.replace("0.5", '0.5, "new": 1')], [row], 1e-9, is_rows=True))
    for other in (row.replace("0.5", "-0.5"), row.replace("no", "a"), row.replace("qw", "qx")):
        assert list(differences([other], [row], 1e-9, is_rows=True))
    for lines in (["moved by 1.03 deg"], ["turned by 1.02 deg"], [line, line]):
        assert list(differences(lines, [line], 1e-9, is_rows=False))


def test_records_of_today_join_those_of_0_9_in_its_tables(tmp_path):
    shutil.copytree(HERE / "calibrations", tmp_path / "calibrations")
    shutil.copytree(HERE / "drift", tmp_path / "drift")
    lake, name = Lake.at(tmp_path), "edge of today"
    for schema, row_type in ((CALIBRATIONS, CalibrationRecord), (DRIFT, DriftFinding)):
        before = read_records(lake, schema, row_type)
        assert {(r.pair, r.parent_frame, r.child_frame) for r in before} == {
            (pair, *frames) for pair, frames in FRAMES_OF_PAIR.items()
        }
        own = replace(before[-1], parent_frame="rear", work_key=name, recorded_at="", asserted_at="")
        assert commit_records(lake, schema, [own]) == 1
        assert commit_records(lake, schema, [own]) == 0
        after = read_records(lake, schema, row_type)
        assert len(after) == len(before) + 1
        assert [r.parent_frame for r in after if r.work_key == name] == ["rear"]


def test_a_table_that_a_newer_release_wrote_is_refused_with_its_version(tmp_path):
    shutil.copytree(HERE / "states", tmp_path / "states")
    newer = replace(STATES, version=STATES.version + 1, reads_versions=(1, 2, 3, STATES.version))
    lake = Lake.at(tmp_path)
    row = read_records(lake, STATES, StateRow)[0]
    commit_records(lake, newer, [replace(row, work_key="newer", recorded_at="", asserted_at="")])
    with pytest.raises(ContractError, match=f"holds states/{newer.version}, this version reads states/"):
        read_records(lake, STATES, StateRow)


def _script(options):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        found = everything_of_a_copy(Path(folder))
    if "--write" in options:
        shutil.rmtree(EXPECTED, ignore_errors=True)
        EXPECTED.mkdir()
        for name, text in found.items():
            (EXPECTED / name).write_text(text)
    wrong = {name: compared(found, name, 0.0) for name in sorted(found)}
    for name, lines in wrong.items():
        print(name, "equal" if not lines else f"{len(lines)} differ: {lines[0]}")
    return 1 if any(wrong.values()) else 0


if __name__ == "__main__":
    sys.exit(_script(sys.argv[1:]))
