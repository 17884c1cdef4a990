"""The page in a real browser, without a network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flangeye.workflow.log.read import RunLog
from flangeye.workflow.report import write_report
from tests.chromium import chromium

PAINTED = """[...document.querySelectorAll(".gl-container canvas")].map(from => {
  const to = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
  [to.canvas.width, to.canvas.height] = [from.width, from.height];
  to.drawImage(from, 0, 0);
  const pixels = to.getImageData(0, 0, from.width, from.height).data;
  return pixels.filter((value, i) => i % 4 === 3 && value > 0).length;
})"""
"""How many pixels of each 3D canvas are not empty."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as launched:
        yield launched


@pytest.mark.parametrize(
    ("changes", "plots", "verdict"),
    [
        ({"outliers": {"pose-08": "too far"}}, 6, "VERIFIED"),
        ({"finished": False, "solved": False, "clouds": False}, 1, "INCOMPLETE"),
    ],
    ids=["verified", "killed"],
)
def test_the_page_draws_everything_and_asks_for_nothing(
    browser: Any,
    make_run: Callable[..., RunLog],
    tmp_path: Path,
    changes: dict[str, Any],
    plots: int,
    verdict: str,
) -> None:
    path = tmp_path / "report.html"
    write_report(make_run(**changes, points=1000), path)
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
    page.on("request", lambda request: problems.extend(_elsewhere(request.url)))
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-drawn]", timeout=60_000)
    assert problems == []
    assert page.get_by_role("status").locator("strong").inner_text() == verdict
    drawn = page.locator(".js-plotly-plot").filter(has=page.locator("svg.main-svg"))
    assert drawn.count() == plots == page.locator(".plot").count()
    painted = page.evaluate(PAINTED)
    assert len(painted) == plots - ("outliers" in changes)  # all but the bars are in 3D
    assert min(painted) > 1000
    assert page.evaluate("document.documentElement.scrollWidth") == 1400
    page.close()


def _elsewhere(url: str) -> list[str]:
    return [] if url.startswith(("file:", "data:", "blob:")) else [url]


def test_a_narrow_screen_is_not_scrolled_sideways_and_the_matrix_can_be_copied(
    browser: Any, make_run: Callable[..., RunLog], tmp_path: Path
) -> None:
    path = tmp_path / "report.html"
    log = make_run(ids=[f"{'x' * 90}{i}" for i in range(5)], clouds=False, note="/" + "x" * 90)
    write_report(log, path)
    page = browser.new_page(viewport={"width": 420, "height": 900})
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-drawn]", timeout=60_000)
    assert page.evaluate("document.documentElement.scrollWidth") == 420
    page.evaluate("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
    page.get_by_role("button", name="Copy").click()
    page.get_by_role("button", name="Copied").wait_for()
    assert len(page.evaluate("window.copied").split()) == 16
    page.close()


def test_a_telephone_scrolls_down_only(
    browser: Any, make_run: Callable[..., RunLog], tmp_path: Path
) -> None:
    path = tmp_path / "report.html"
    library = tmp_path / "plotly.js"
    log = make_run(outliers={"tool0_15450164880_870971918106": "too far"}, points=1000)
    write_report(log, path, library)
    assert path.stat().st_size < 1_000_000  # plotly.js is beside it
    page = browser.new_page(viewport={"width": 420, "height": 900})
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-drawn]", timeout=60_000)
    assert page.evaluate("document.documentElement.scrollWidth") == 420
