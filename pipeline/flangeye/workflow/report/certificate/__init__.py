"""A printed page that states a calibration and its uncertainty after the GUM."""

import os
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from flangeye.errors import StageError
from flangeye.files.paths import VERSION
from flangeye.files.regular import write_whole
from flangeye.models.scanners import ScannerModel
from flangeye.types import PoseFeature
from flangeye.workflow.log.read import read_run
from flangeye.workflow.report.certificate.budget import (
    Conditions,
    Contribution,
    Share,
    budget_of,
    shares_of,
    use_budget_of,
)
from flangeye.workflow.report.facts import Facts, facts_of, provenance_of
from flangeye.workflow.report.look import templates
from flangeye.workflow.report.summary import transform_text
from flangeye.workflow.report.units import degrees, millimetres
from flangeye.workflow.result import result_of_camera, status_of
from flangeye.workflow.result.sections import expected_error

LEAST_LENGTH = 1e-6
"""Smallest uncertainty that is printed as a number [m]; the page shows three decimals of a mm."""


def write_certificate(
    run: Path, path: Path | None, conditions: Conditions, camera: str | None = None
) -> Path:
    """Write the certificate of a run and return its path.

    Args:
        run: The run's folder or its ``run.mcap``.
        path: Path of the file; by default ``certificate.html`` beside the log.
        conditions: Ambient conditions stated by the user.
        camera: The certified camera, for a cell.

    Raises:
        StageError: There is no log, it is damaged or has no calibration, no camera of a cell was
            chosen, or the file cannot be written.
    """
    log = run / "run.mcap" if run.is_dir() else run
    read = read_run(log)
    read.require_sound()
    facts = facts_of(read)
    facts = replace(facts, result=result_of_camera(facts.result, camera))
    page = render(facts, conditions)
    path = path or log.parent / f"certificate{f'-{camera}' if camera else ''}.html"
    write_whole(path, page)
    return path


def print_pdf(page: Path) -> Path | None:
    """Print a page to a PDF beside it with Chromium; return None if Chromium is not installed.

    Raises:
        StageError: Chromium fails to print the complete page.
    """
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        return None
    out = page.with_suffix(".pdf")
    options = ["--headless", *sandbox(), "--disable-gpu", "--no-pdf-header-footer"]
    try:
        with tempfile.TemporaryDirectory(dir=page.parent) as folder:
            draft = Path(folder).resolve() / out.name
            command = [browser, *options, f"--print-to-pdf={draft}", page.resolve().as_uri()]
            ended = subprocess.run(command, check=False, capture_output=True, timeout=120)
            # On a full disk Chromium prints a part, or nothing, and ends as if all were well
            if ended.returncode or not draft.read_bytes().rstrip().endswith(b"%%EOF"):
                raise StageError(
                    f"{out}: {browser} does not print all of it (exit code {ended.returncode}); "
                    f"{page} is complete, print it yourself"
                )
            draft.replace(out)
    except subprocess.TimeoutExpired:
        raise StageError(f"{out}: {browser} does not print it within 120 s") from None
    except OSError as error:
        raise StageError(f"{out}: {browser} does not print: {error.strerror or error}") from None
    return out


def sandbox() -> list[str]:
    """Return Chromium's sandbox flags: root must switch it off, others keep it."""
    return ["--no-sandbox"] if getattr(os, "geteuid", lambda: 1)() == 0 else []


def render(facts: Facts, conditions: Conditions) -> str:
    """Return the page as text."""
    environment = templates(Path(__file__).parent)
    environment.filters |= {"mm": millimetres, "standard": standard_text, "part": part_text}
    return environment.get_template("certificate.html.j2").render(_content(facts, conditions))


def standard_text(row: Contribution | Share) -> str:
    """Return a standard uncertainty with its unit; "below" if it is only a bound."""
    angle = isinstance(row, Contribution) and row.unit == "rad"
    # Smallest uncertainty that is printed as a number [rad]: 0.0001 degrees
    shown, least = (degrees, 1.75e-6) if angle else (millimetres, LEAST_LENGTH)
    bound = row.standard < least or (isinstance(row, Contribution) and row.bound)
    return f"{'below ' if bound else ''}{shown(max(row.standard, least))}{'°' if angle else ' mm'}"


def part_text(metres: float) -> str:
    """Return one contribution's displacement of the point along an axis, as text [mm]."""
    if metres == 0:
        return "–"
    return millimetres(metres) if abs(metres) >= LEAST_LENGTH / 2 else "< 0.001"


def _content(facts: Facts, conditions: Conditions) -> dict[str, Any]:
    result = facts.result
    scanner = facts.model("scanners")
    return {
        "result": result,
        "status": status_of(result),
        "budget": budget_of(result),
        "shares": shares_of(result),
        "use": use_budget_of(result, scanner, conditions),
        "transform": transform_text(*next(iter(result.transforms.items()))),
        "objects": _objects(facts, scanner),
        "conditions": conditions,
        "expected": expected_error(result),
        "used": sum(o.used for o in result.observations),
        "provenance": provenance_of(facts),
        "version": VERSION,
    }


def _objects(facts: Facts, scanner: ScannerModel | None) -> list[tuple[str, str]]:
    """Return names and values of the calibrated devices and the target."""
    rows = {
        "Robot": str(facts.section("robot").get("model", "")),
        "Scanner": f"{scanner.maker} {scanner.model}" if scanner else "",
        "Target": _target(facts),
        "Configuration": _configured(facts),
        "Serial": str(_serial(facts.section("scanner"))),
    }
    return [(name, value) for name, value in rows.items() if value]


def _target(facts: Facts) -> str:
    """Return a text that describes the target."""
    if targets := facts.section("cell").get("targets"):
        return ", ".join(map(str, targets)) if isinstance(targets, dict) else ""
    if body := facts.section("target").get("body"):
        return "the arm's own links" if body == "robot" else f"a body by its mesh, {body}"
    if any(isinstance(seen.feature, PoseFeature) for seen in facts.log.observations()):
        return "a marker"
    feature = facts.section("feature")
    sphere = feature.get("sphere")
    if isinstance(sphere, dict):
        return f"a sphere of {sphere.get('diameter')}"
    return str(feature.get("standard") or "the robot's flange")


def _configured(facts: Facts) -> str:
    if facts.of_cell:
        return "a cell of several cameras, arms or targets, all calibrated at once"
    return str(facts.section("configuration").get("name", "eye-on-base"))


def _serial(section: dict[str, Any]) -> str:
    driver = section.get("driver")
    settings = next(iter(driver.values()), None) if isinstance(driver, dict) else None
    return str(settings.get("serial", "")) if isinstance(settings, dict) else ""
