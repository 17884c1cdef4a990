"""The tables and the page, from outcomes made up here."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flangeye.files.paths import storage_at
from flangeye.workflow.batch import _write_results
from flangeye.workflow.batch.dataset import ColumnType, Dataset, Ledger, columns_of, row_of
from flangeye.workflow.batch.outcome import SessionOutcome
from flangeye.workflow.batch.page import drawings_of, write_page
from flangeye.workflow.batch.page import render as rendered
from flangeye.workflow.batch.plan import BatchSession, Software
from flangeye.workflow.batch.progress import Batch, Tally, summary_text
from flangeye.workflow.batch.work import Job

EVIL = "<script>alert(1)</script>"


def session(i, archive=None, **varied):
    return BatchSession(f"toy_{i:016d}", str(i), Path("/r/toy.yaml"), archive, (), varied, i)


def outcome(rms=3e-4, **more):
    report = more.pop("report", "toy_0000000000000000/report.html")
    return SessionOutcome("verified", None, 5, 6, rms, rms, 2 * rms, rms, 2 * rms, seconds=1.5,
                   report=report, **more)  # fmt: skip


def columns(entries: Any) -> dict[str, ColumnType]:
    paths = entries[0][0].varied
    return columns_of({path: [session.varied[path] for session, _ in entries] for path in paths})


def tally_of(entries: Any) -> Tally:
    """Return the tally of sessions, as it is gathered in blocks of five hundred."""
    kinds = columns(entries)
    tally = Tally(kinds, tuple(entries[0][0].varied), len(entries))
    rows = [row_of(session, outcome, kinds) for session, outcome in entries]
    for first in range(0, len(rows), 500):
        schema = pa.schema(list(kinds.items()))
        tally.add(pa.Table.from_pylist(rows[first : first + 500], schema))
    return tally


def render(entries: Any) -> str:
    return rendered(tally_of(entries))


def drawings(entries: Any) -> Any:
    tally = tally_of(entries)
    return drawings_of(tally.sample, tally.varied)


@pytest.fixture
def entries() -> Any:
    return [
        (session(0, **{"steps.0.noise": "0.1 mm", "steps.0.count": "5"}), outcome(1e-4)),
        (session(1, **{"steps.0.noise": "0.2 mm", "steps.0.count": "6"}), outcome(2e-4)),
        (session(2, **{"steps.0.noise": "0.2 mm", "steps.0.count": "6"}),
         SessionOutcome("failed", f"bad, {EVIL}\x1b[2J", seconds=0.1)),
    ]  # fmt: skip


def test_csv_and_parquet_hold_the_same(entries: Any, tmp_path: Path) -> None:
    kinds = columns(entries)
    job = Job(str(tmp_path), False, Software("1", ()), kinds)
    dataset = Dataset(job.place, kinds)
    for number, (session, outcome) in reversed(list(enumerate(entries))):
        dataset.write_part(0, str(number), [row_of(session, outcome, kinds)])
    tally = Tally(kinds, tuple(entries[0][0].varied), 3)
    _write_results(job, dataset, Ledger([session for session, _ in entries]), tally)
    assert [path.name for path in (tmp_path / "sessions.parquet").iterdir()] == ["000000.parquet"]
    with (tmp_path / "sessions.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    table = pq.read_table(tmp_path / "sessions.parquet")
    rows = table.to_pylist()
    assert len(read) == len(rows) == 3
    for text, row in zip(read, rows, strict=True):
        plain = {k: "" if v is None else str(v) for k, v in row.items()}
        assert text == {k: v.replace("\x1b", "\\x1b") for k, v in plain.items()}
    assert rows[1]["holdout_rms_m"] == 2e-4
    assert rows[2]["holdout_rms_m"] is None
    assert rows[2]["reason"] == f"bad, {EVIL}\x1b[2J"
    assert table.schema.field("steps.0.noise").type == pa.string()
    assert table.schema.field("steps.0.count").type == pa.int64()
    assert table.schema.field("true_rms_m").type == pa.float64()
    assert table.schema.field("archive").type == pa.string()


def test_simulated_sessions_are_named_so(entries: Any) -> None:
    assert "SIMULATED" not in render(entries)
    (first, found), *others = entries
    tally = tally_of([(first, replace(found, origin="simulated")), *others])
    assert ">simulated</td>" in rendered(tally)
    assert "SIMULATED: 1 of 3 sessions" in rendered(tally)
    text = summary_text(Batch("out", tally, 0)).splitlines()[0]
    assert text == "3 sessions: 2 verified, 1 failed (1 simulated)"


def test_columns(entries: Any) -> None:
    assert tuple(columns(entries)) == (
        "session", "recipe", "archive", "steps.0.noise", "steps.0.count", "seed", "status",
        "reason", "used", "captures", "holdout_rms_m", "holdout_median_m", "holdout_p95_m",
        "expected_rms_m", "expected_p95_m", "true_rms_m", "true_centre_m", "true_rotation_rad",
        "seconds", "report", "origin",
    )  # fmt: skip


def test_quantities_stand_on_an_axis_by_their_number(entries: Any) -> None:
    drawn = dict(drawings(entries))
    assert set(drawn) == {"Held-out error, rms", "Expected error, 95 %", "Time"}
    figure = drawn["Held-out error, rms"]
    assert figure["layout"]["xaxis"]["title"]["text"] == "step 0.noise [mm]"
    dots = [dict(zip(t["x"], t["y"], strict=True)) for t in figure["data"]]
    assert dots == [{0.1: pytest.approx(0.1)}, {0.2: pytest.approx(0.2)}]
    assert [trace["name"] for trace in figure["data"]] == ["5", "6"]
    first, second = (trace["marker"]["color"] for trace in figure["data"])
    assert first != second


def test_names_stand_side_by_side_and_medians_join_repetitions() -> None:
    entries = [
        (session(i, **{"steps.3.cost": cost}), outcome(rms * 1e-3))
        for i, (cost, rms) in enumerate([("a", 1), ("a", 2), ("a", 4), ("b", 3), ("b", 5)])
    ]
    figure = dict(drawings(entries))["Held-out error, rms"]
    assert figure["layout"]["xaxis"]["type"] == "category"
    *_, medians = figure["data"]
    assert (medians["x"], medians["y"]) == (["a", "b"], [2.0, 4.0])


def test_the_page_escapes_what_it_is_given_and_asks_for_nothing(entries: Any) -> None:
    page = render(entries)
    assert EVIL not in page
    assert "bad, &lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert '<a href="toy_0000000000000000/report.html">' in page
    own = re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    assert not re.search(r"(src|href)=\"(?!toy_)", own)
    assert "default-src 'none'" in page


def test_archives_are_told_apart_by_what_differs() -> None:
    paths = ["/data/a/poses", "/data/b/poses", f"/data/{EVIL}"]
    page = render([(session(i, path), outcome()) for i, path in enumerate(paths)])
    assert '<td class="">a/poses</td>' in page
    assert EVIL not in page


def test_variants_are_summed_up_when_repeated(entries: Any) -> None:
    page = render(entries)
    assert '<h2 id="variants">' in page
    assert '<h2 id="variants">' not in render(entries[:2])
    row = re.search(r"<tr><td>0.2 mm</td><td>6</td>(.*?)</tr>", page, re.S).group(1)
    assert re.findall(r">([^<>]*)</td>", row) == ["2", "1", "1", "0.200", "0.400", ""]


def test_a_page_of_very_many_sessions_shows_the_worst() -> None:
    many = [(session(i), replace(outcome(), holdout_rms_m=1e-6 * i)) for i in range(1200)]
    many[5] = (session(5), SessionOutcome("crashed", "no"))
    page = render(many)
    assert "1000 of 1200: those without a calibration" in page
    assert "toy_0000000000000005" in page and "toy_0000000000001199" in page
    assert "toy_0000000000000006<" not in page and len(page) < 6e6


def test_nothing_accepted_still_makes_a_page() -> None:
    entries = [(session(0), SessionOutcome("crashed", "no"))]
    page = render(entries)
    assert "1 sessions" not in page
    assert "1 session of toy" in page


def test_the_table_sorts_in_a_browser(entries: Any, tmp_path: Path) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    write_page(tally_of(entries), storage_at(str(tmp_path)))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND"]
    problems: list[str] = []
    requested: list[str] = []
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda r: requested.append(r.url))
        page.goto((tmp_path / "summary.html").as_uri())
        page.wait_for_selector("html[data-drawn='3']", timeout=30_000)
        heading = page.locator("section").last.get_by_role("button", name="Held-out rms")
        orders = []
        for _ in range(2):
            heading.click()
            cells = page.locator("section").last.locator("tbody tr td:first-child")
            orders.append([text[-1] for text in cells.all_inner_texts()])
        browser.close()
    assert problems == []
    assert all(url.startswith("file:") for url in requested)
    assert orders == [["0", "1", "2"], ["1", "0", "2"]]  # what has no figure stays last


def test_figures_are_plain_json(entries: Any) -> None:
    json.dumps([figure for _, figure in drawings(entries)], allow_nan=False)
