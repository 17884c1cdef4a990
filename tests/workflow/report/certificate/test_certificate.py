"""The certificate states what result.json says, and its budget is that of another library."""

from __future__ import annotations

import html
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.errors import StageError
from flangeye.models.loading import load_model
from flangeye.types.geometry import covariance_at
from flangeye.workflow.log.read import read_run
from flangeye.workflow.report.certificate import (
    print_pdf,
    render,
    sandbox,
    standard_text,
    write_certificate,
)
from flangeye.workflow.report.certificate.budget import (
    Conditions,
    Share,
    budget_of,
    shares_of,
    use_budget_of,
)
from flangeye.workflow.report.facts import facts_of
from flangeye.workflow.report.units import millimetres
from flangeye.workflow.result.contract import ExpectedErrorResult, Result
from tests.workflow.report.conftest import WORKSPACE, Script, scripted

SCANNER = load_model("scanners", "phoxi-m")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    scripted(Script(points=200), folder / "run.mcap")
    return folder


@pytest.fixture(scope="module")
def result(run: Path) -> Result:

    return Result.model_validate(read_run(run / "run.mcap").result)


def test_every_number_is_that_of_result_json(run: Path, result: Result, tmp_path: Path) -> None:
    page = write_certificate(run, tmp_path / "c.html", Conditions(21.0, 8.0, "Hall 3", "A & B"))
    text = re.sub(r"<[^>]+>", " ", page.read_text())
    assert result.holdout
    for value in (
        result.holdout.rms,
        result.holdout.median,
        result.holdout.p95,
    ):
        assert f"{millimetres(value)} mm" in text
    for number in np.ravel(result.transforms["base_T_camera"].matrix):
        assert f"{number:z.9f}" in text
    for said in (result.provenance.recipe_hash, "A &amp; B", "21 °C, 8 K", result.title):
        assert said in text
    assert "script" not in page.read_text()


def test_the_combined_uncertainty_is_the_covariance_of_the_mapped_point(result: Result) -> None:
    estimate, budget = result.transforms["base_T_camera"], budget_of(result)
    covariance, about = np.array(estimate.covariance), np.array(estimate.about)
    expected = covariance_at(covariance, about, budget.point[None])[0]
    np.testing.assert_allclose(budget.covariance, expected, rtol=1e-12)
    grid = covariance_at(covariance, about, WORKSPACE.grid())
    assert result.workspace
    assert np.trace(budget.covariance) == pytest.approx(
        max(np.trace(grid, axis1=1, axis2=2)), rel=1e-9
    )


def test_the_calibrations_budget_agrees_with_gtc(result: Result) -> None:
    gtc = pytest.importorskip("GTC", reason="GTC is not installed")
    estimate, budget = result.transforms["base_T_camera"], budget_of(result)
    phi, tau = _quantities(gtc, np.array(estimate.covariance))
    lever = budget.point - np.array(estimate.about)
    moved = [
        phi[1] * lever[2] - phi[2] * lever[1] + tau[0],
        phi[2] * lever[0] - phi[0] * lever[2] + tau[1],
        phi[0] * lever[1] - phi[1] * lever[0] + tau[2],
    ]
    np.testing.assert_allclose(budget.standard, [gtc.uncertainty(x) for x in moved], rtol=1e-9)
    expanded = [gtc.reporting.k_factor(gtc.dof(x)) * gtc.uncertainty(x) for x in moved]
    np.testing.assert_allclose(budget.expanded, expanded, rtol=1e-6)


def _quantities(gtc: Any, covariance: np.ndarray) -> tuple[list[Any], list[Any]]:
    sigma = np.sqrt(np.diag(covariance))
    found = [gtc.ureal(0.0, float(u), independent=False) for u in sigma]
    for i in range(6):
        for j in range(i):
            gtc.set_correlation(float(covariance[i, j] / sigma[i] / sigma[j]), found[i], found[j])
    return found[:3], found[3:]


def test_the_budget_of_use_agrees_with_gtc(result: Result) -> None:
    gtc = pytest.importorskip("GTC", reason="GTC is not installed")
    budget = use_budget_of(result, SCANNER, Conditions(spread=8.0))
    for axis in range(3):
        parts = [
            gtc.ureal(0.0, float(c.standard), float(c.freedom))
            for c in budget.contributions
            if c.sensitivity[axis]
        ]
        assert len(parts) == 4
        total = sum(parts[1:], parts[0])
        assert budget.standard[axis] == pytest.approx(gtc.uncertainty(total), rel=1e-9)
        assert budget.freedom[axis] == pytest.approx(gtc.dof(total), rel=1e-6)
        factor = gtc.reporting.k_factor(gtc.dof(total))
        assert budget.coverage[axis] == pytest.approx(factor, rel=1e-6)


def test_the_causes_add_up_to_the_calibrations_uncertainty(result: Result) -> None:
    (name, estimate), *_ = result.transforms.items()
    parts = {"sag": 0.5, "joint zeros": 0.3, "drift": 0.004}
    told = {c: (p * np.array(estimate.covariance)).tolist() for c, p in parts.items()}
    told_of = result.model_copy(
        update={"transforms": {name: estimate.model_copy(update={"shares": told})}}
    )
    total = float(np.sum(budget_of(result).standard ** 2))
    shares = {s.cause: s.standard**2 / total for s in shares_of(told_of)}
    expected = {"sag": 0.5, "joint zeros": 0.3, "sizes of these causes": 0.196, "others": 0.004}
    assert shares == pytest.approx(expected, rel=1e-9)
    assert list(shares) == list(expected)
    (alone,) = shares_of(result)  # a solver that does not say
    assert alone.standard**2 == pytest.approx(total, rel=1e-9)


def test_correlated_quantities_are_named(result: Result) -> None:
    covariance = np.array(result.transforms["base_T_camera"].covariance)
    covariance[0, 1] = covariance[1, 0] = 0.8 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    changed = result.model_copy(deep=True)
    changed.transforms["base_T_camera"].covariance = covariance.tolist()
    (first, second, r), *_ = budget_of(changed).correlated
    assert (first, second) == ("Rotation about x", "Rotation about y")
    assert r == pytest.approx(0.8)


def test_the_command_writes_the_page_and_prints_it(run: Path, tmp_path: Path) -> None:
    page = tmp_path / "c.html"
    done = CliRunner().invoke(commands(), ["certificate", str(run), "--out", str(page), "--no-pdf"])
    assert done.exit_code == 0 and page.exists()
    printed = print_pdf(page)
    if printed is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    assert len(re.findall(rb"/Type\s*/Page[^s]", printed.read_bytes())) <= 2


@pytest.mark.parametrize(
    "printed",
    ["true", 'printf %%PDF-1.4 > "$to"', 'printf "%%PDF-1.4 %%%%EOF" > "$to"; kill -5 $$'],
)
def test_a_pdf_that_is_not_whole_is_said_and_the_old_one_stays(
    printed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What Chromium leaves on a full disk: nothing, or a part, and no word; or it is killed."""
    browser = tmp_path / "bin" / "chromium"
    browser.parent.mkdir()
    find = "for word; do case $word in --print-to-pdf=*) to=${word#*=};; esac; done"
    browser.write_text(f"#!/bin/sh\n{find}\n{printed}\n")
    browser.chmod(0o755)
    monkeypatch.setenv("PATH", str(browser.parent), prepend=os.pathsep)
    page, old = tmp_path / "certificate.html", tmp_path / "certificate.pdf"
    page.write_text("<p>new")
    old.write_bytes(b"%PDF-1.4 old %%EOF")
    with pytest.raises(StageError, match=r"certificate.pdf: .* does not print") as error:
        print_pdf(page)
    assert "--" not in str(error.value)  # the reason, not the command
    assert old.read_bytes() == b"%PDF-1.4 old %%EOF"
    assert {each.name for each in tmp_path.iterdir()} == {"bin", page.name, old.name}


def test_without_a_calibration_there_is_nothing_to_certify(tmp_path: Path) -> None:
    scripted(Script(solved=False, verified=None, points=50), tmp_path / "run.mcap")
    with pytest.raises(StageError, match="gave no calibration, so there is nothing to certify"):
        write_certificate(tmp_path, None, Conditions())


def test_a_damaged_log_is_not_certified(run: Path, tmp_path: Path) -> None:
    raw = bytearray((run / "run.mcap").read_bytes())
    raw[len(raw) // 4] ^= 1
    (tmp_path / "run.mcap").write_bytes(raw)
    with pytest.raises(StageError, match=r"run.mcap: damaged: .* checksum does not match"):
        write_certificate(tmp_path, None, Conditions())
    assert not (tmp_path / "certificate.html").exists()


def test_the_browser_keeps_its_sandbox_but_for_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert sandbox() == []
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert sandbox() == ["--no-sandbox"]


def test_printed_rows_reconcile_to_the_printed_total(run: Path, tmp_path: Path) -> None:
    page = write_certificate(run, tmp_path / "c.html", Conditions(spread=8.0)).read_text()
    _, use = re.findall(r"<tbody>((?:(?!<tbody>).)*)</tbody>\s*<tfoot>(.*?)</tfoot>", page, re.S)
    parts = [_numbers(row)[-3:] for row in use[0].split("</tr>") if "<tr>" in row]
    total = _numbers(use[1].split("</tr>")[0])
    # Rows of one table are independent along each axis, each printed to half a micrometre.
    rows = np.sqrt((np.array(parts) ** 2).sum(axis=0))
    np.testing.assert_allclose(rows, total, atol=0.0005 * np.sqrt(len(parts)) + 0.0005)


def _numbers(row: str) -> list[float]:
    cells = re.findall(r'<td class="n">(.*?)</td>', row)
    plain = [re.sub(r"below |< | mm|°", "", cell).replace("–", "0") for cell in cells]
    return [float(cell) for cell in plain]


def test_the_expected_error_is_printed_once(run: Path) -> None:
    facts = facts_of(read_run(run / "run.mcap"))
    error = ExpectedErrorResult(rms=0.123e-3, p95=0.234e-3)
    known = replace(facts, result=facts.result.model_copy(update={"expected_error": error}))
    text = re.sub(r"<[^>]+>", "", render(known, Conditions()))
    assert [text.count(each) for each in ("0.123 mm rms; 95 % below 0.234 mm", "0.123")] == [1, 1]


def test_no_uncertainty_is_printed_as_zero(result: Result, run: Path, tmp_path: Path) -> None:
    quiet = result.model_copy(deep=True)
    assert quiet.holdout and quiet.workspace
    quiet.holdout.rms = 1e-9
    (one, *_) = [
        c for c in use_budget_of(quiet, SCANNER).contributions if c.name.startswith("Arm and scan")
    ]
    assert one.bound
    for row in (one, Share("sag", 1e-12, "")):
        assert re.fullmatch(r"below 0\.\d*[1-9]\d* mm", standard_text(row))
    text = write_certificate(run, tmp_path / "c.html", Conditions()).read_text()
    assert not re.search(r'<td class="n">0\.0+( mm|°)?</td>', text)


@pytest.mark.parametrize(
    ("recipe", "target"),
    [
        ("target: {body: gripper.stl, at: flange}", "a body by its mesh, gripper.stl"),
        ("target: {body: robot}", "the arm's own links"),
        ("feature: {sphere: {diameter: 38.1 mm}}", "a sphere of 38.1 mm"),
        ("feature: {standard: ISO 9409-1-50-4-M6}", "ISO 9409-1-50-4-M6"),
        ("robot: ur5", "the robot's flange"),
        ("target: [1]\nfeature: 4\nrobot: [ur5]\nscanner: 3", "the robot's flange"),
        ("cell: {targets: {left: arm, right: arm}}", "left, right"),
    ],
)
def test_the_target_is_said_as_the_recipe_has_it(run: Path, recipe: str, target: str) -> None:
    log = read_run(run / "run.mcap")
    log.attachments["recipe.resolved.yaml"] = log.attachments["recipe.yaml"] = recipe.encode()
    page = html.unescape(render(facts_of(log), Conditions()))
    assert re.search(rf"Target\s*(<[^>]+>\s*)+{re.escape(target)}\s*<", page)


def test_a_simulation_has_a_watermark_and_nothing_to_sign(run: Path, tmp_path: Path) -> None:
    facts = facts_of(read_run(run / "run.mcap"))
    pages = [
        render(
            replace(facts, result=facts.result.model_copy(update={"simulated": simulated})),
            Conditions(),
        )
        for simulated in (True, False)
    ]
    assert ['class="watermark"' in page for page in pages] == [True, False]
    assert ["Calibrated by" in page for page in pages] == [False, True]
    assert ["not a certificate" in page for page in pages] == [True, False]
