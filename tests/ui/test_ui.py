"""The page in a real browser: from an empty folder to an exported file, and its bad days.

With FLANGEYE_PICTURES=1 the pictures in docs/images are made again.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from flangeye.errors import StageError
from flangeye.recipe.load import find_recipe
from flangeye_ui.plan_page import stops_of
from flangeye_ui.project import _mistake
from flangeye_ui.server import require_free
from tests.ui.conftest import Served, ended, serve

PICTURES = Path(__file__).parents[2] / "docs" / "images"
SMALL = """title: A small cell
robot: {model: ur5}
scanner: {model: phoxi-m}
steps:
  - acquire.simulated: {resolution: 0.25, poses: {grid: {counts: [2, 2, 2]}}}
  - segment.flange
  - fit.rim
  - solve.robust
  - verify.holdout: {max_rms: 3 mm}
"""


def shot(page: Any, name: str) -> None:
    if os.environ.get("FLANGEYE_PICTURES"):
        PICTURES.mkdir(exist_ok=True)
        page.wait_for_timeout(1500)
        page.screenshot(path=PICTURES / f"ui_{name}.png")


def opened(browser: Any, served: Served, **options: Any) -> Any:
    page = browser.new_context(viewport={"width": 1280, "height": 860}, **options).new_page()
    page.set_default_timeout(60_000)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on(
        "request",
        lambda r: (
            page.problems.append(r.url)
            if "127.0.0.1" not in r.url and not r.url.startswith(("data:", "blob:"))
            else None
        ),
    )
    page.goto(served.address)
    page.get_by_role("heading", name="Cell").wait_for()
    return page


def go(page: Any, name: str) -> None:
    page.get_by_role("link", name=name, exact=True).click()
    page.get_by_role("heading", name=name, exact=True).wait_for()


def write_recipe(page: Any, text: str) -> None:
    page.get_by_label("Recipe in YAML").fill(text)


@pytest.mark.slow
def test_from_an_empty_folder_to_an_exported_file(browser: Any, served: Served) -> None:
    page = opened(browser, served)
    write_recipe(page, SMALL.replace("0.25", "quarter"))
    page.get_by_role("alert").first.wait_for()
    assert "resolution" in page.get_by_role("alert").all_inner_texts()[-1]
    shot(page, "cell_mistake")
    write_recipe(page, SMALL)
    page.get_by_text("The recipe is sound.").wait_for()
    shot(page, "cell")
    write_recipe(page, find_recipe("ur5e_phoxi-m_loopback").read_text())
    page.get_by_text("The recipe is sound.").wait_for()
    go(page, "Plan")
    place = page.get_by_label("Where the scanner stands (x, y, z in the base)")
    place.fill("600 mm, 0 mm, 950 mm")
    place.press("Tab")
    page.wait_for_load_state()
    page.get_by_role("heading", name="Plan").wait_for()
    shot(page, "plan")
    assert "600 mm" in (served.folder / "cell.yaml").read_text()
    go(page, "Cell")
    write_recipe(page, SMALL)
    page.get_by_text("The recipe is sound.").wait_for()
    go(page, "Run")
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_text("runs.").wait_for()
    assert slowest_answer(served) < 0.1
    page.get_by_text("fitted 0003").wait_for(timeout=120_000)
    shot(page, "run")
    page.get_by_text("done (exit code 0)").wait_for(timeout=180_000)
    go(page, "Verdict")
    page.get_by_text("Verified: ").wait_for()
    page.get_by_role("tab", name="ur", exact=True).click()
    page.get_by_text("flangeye export runs/").wait_for()
    page.get_by_role("button", name="Write the file").click()
    page.get_by_text("exports/").first.wait_for()
    page.get_by_role("heading", name="Verdict").scroll_into_view_if_needed()
    shot(page, "verdict")
    go(page, "Archive")
    page.get_by_text("capture 0000").wait_for()
    shot(page, "archive")
    assert list(served.folder.glob("runs/*/exports/*"))
    assert page.problems == []


def slowest_answer(served: Served) -> float:
    """Return the longest of ten answers while scans are being processed [s], the best of three."""
    return min(max(_answer(served) for _ in range(10)) for _ in range(3))


def _answer(served: Served) -> float:
    began = time.perf_counter()
    with pytest.raises(urllib.error.HTTPError) as denied:
        urllib.request.urlopen(f"http://127.0.0.1:{served.port}/run")
    denied.value.close()
    return time.perf_counter() - began


def test_narrow_dark_and_by_keyboard_alone(browser: Any, served: Served) -> None:
    page = opened(browser, served, color_scheme="dark")
    page.set_viewport_size({"width": 390, "height": 800})
    for name in ("Cell", "Plan", "Run"):
        go(page, name)
        page.wait_for_timeout(500)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, name
        shot(page, f"narrow_dark_{name.lower()}")
    assert page.evaluate("document.body.classList.contains('body--dark')")
    reached = set()
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.innerText"))
    assert {"Cell", "Plan", "Run", "Verdict", "Archive"} <= reached
    assert any("START" in str(text).upper() for text in reached)
    assert any("STOP" in str(text).upper() for text in reached)


@pytest.mark.slow
def test_the_space_bar_stops_a_run_and_a_second_page_sees_it(browser: Any, served: Served) -> None:
    page = opened(browser, served)
    write_recipe(page, SMALL.replace("0.25", "1.0"))
    page.get_by_text("The recipe is sound.").wait_for()
    go(page, "Run")
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_text("runs.").wait_for()
    second = page.context.new_page()
    second.goto(f"http://127.0.0.1:{served.port}/run")
    second.get_by_text("another page started it").wait_for()
    page.reload()  # the run is found again, and nothing was started by it
    page.get_by_text("another page started it").wait_for()
    page.locator("body").press(" ")
    page.get_by_text("stopped on this page").wait_for()
    assert len(list(served.folder.glob("runs/*"))) <= 1


def test_without_the_token_nobody_gets_in(served: Served) -> None:
    for path in ("/", "/run", "/?token=wrong", "/_nicegui/x", "/runs/x"):
        with pytest.raises(urllib.error.HTTPError) as denied:
            urllib.request.urlopen(f"http://127.0.0.1:{served.port}{path}")
        with denied.value as answer:
            assert answer.code == 403
            assert answer.read().decode().splitlines() == [
                "wrong or missing token: open the address that 'flangeye ui' printed"
            ]


def test_a_log_that_cannot_be_read_is_one_line(browser: Any, served: Served) -> None:
    broken = served.folder / "runs" / "broken"
    broken.mkdir()
    (broken / "run.mcap").write_bytes(b"no log at all")
    page = opened(browser, served)
    go(page, "Verdict")
    page.get_by_role("alert").wait_for()
    assert "is not an MCAP file" in page.get_by_role("alert").inner_text()
    go(page, "Archive")
    page.get_by_text("is not an MCAP file").wait_for()


def test_a_port_that_is_taken_is_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(StageError, match=rf"127.0.0.1:{port} cannot be listened on .* --port"):
            require_free("127.0.0.1", port)


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "flangeye.cli", "ui", str(tmp_path / "nowhere")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"error: {tmp_path / 'nowhere'}: is not a folder\n"


def test_the_servers_death_ends_its_run(tmp_path: Path) -> None:
    from flangeye.plugin.registry import load_registry
    from flangeye_ui.project import Project

    project = Project(tmp_path, load_registry())
    project.text = SMALL.replace("0.25", "1.0")
    project.start(move=False, owner="page")
    assert project.run is not None and project.run.code is None
    project.page_gone("page")
    assert not project.run.stopped  # nothing moves, so nothing is stopped
    project.run.moves = True
    project.page_gone("another page")
    assert not project.run.stopped
    project.page_gone("page")
    assert [project.run.stopped] == ["the page was closed"]
    deadline = time.monotonic() + 30
    while project.run.code is None and time.monotonic() < deadline:
        time.sleep(0.05)
    assert project.run.code not in (None, 0)


def test_a_recipes_mistake_stands_at_its_field() -> None:
    found = _mistake("cell.yaml:7: steps.2.fit.rim.inlier: '3' has no unit")
    assert (found.line, found.path) == (7, "steps.2.fit.rim.inlier")
    assert _mistake("cell.yaml: no such file").text == "cell.yaml: no such file"


def test_the_plans_rows_are_read_as_the_command_prints_them() -> None:
    text = """2 stops, 9 s under way; 4 were wanted (2 too near a joint's limit left out)
stop  for           flange at (mm, base)    tilt  way       time
0000  verification    450.0    12.5   310.0   10 deg  direct     4.1 s
0001  calibration     400.0   -12.5   290.0   20 deg  barred: outside the box
"""
    stops = stops_of(text)
    assert [s.barred for s in stops] == [False, True]
    np.testing.assert_allclose(stops[1].place, [0.4, -0.0125, 0.29])


def test_thinning_a_large_scan_costs_less_than_making_its_message() -> None:
    from flangeye.log import foxglove
    from flangeye.types import PointCloud
    from flangeye_ui.process import POINTS, thinned

    xyz = np.random.default_rng(0).normal(size=(3_200_000, 3)).astype(np.float32)
    began = time.process_time()
    data = foxglove.point_cloud(PointCloud("camera", xyz), xyz, 0).SerializeToString()
    made = time.process_time()
    thin = thinned(data)
    assert time.process_time() - made < made - began
    assert POINTS <= len(thin) <= 2 * POINTS


@pytest.mark.realtime
@pytest.mark.slow
def test_the_pages_death_stops_the_arm(browser: Any, tmp_path: Path) -> None:
    from tests.live.cell import Cell

    with Cell(tmp_path) as cell:
        cell.recipe(count=8).rename(tmp_path / "cell.yaml")
        served = serve(tmp_path)
        try:
            page = opened(browser, served)
            go(page, "Run")
            page.get_by_role("button", name="Start", exact=True).click()
            page.get_by_text("The arm will move.").wait_for()
            assert cell.standing()
            page.get_by_role("button", name="Move the arm").click()
            cell.wait_until(cell.moving, patience=120)
            page.close()
            cell.wait_until(cell.standing, patience=5)
            time.sleep(2)
            assert cell.standing()
        finally:
            ended(served)
