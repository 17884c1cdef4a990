"""Judge the newest check against the calibration and all checks before it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np

from flangeye.errors import StageError
from flangeye.files.remote import is_this_machine
from flangeye.workflow.doctor.monitor.attribution import attribute_change, explained, suspects
from flangeye.workflow.doctor.monitor.drift import (
    CheckSightings,
    DriftTest,
    DriftVerdict,
    Information,
    information_of,
    misfits,
    moved_since,
    verdict,
)
from flangeye.workflow.doctor.monitor.history import CheckFinding, History, MonitorCheck
from flangeye.workflow.doctor.monitor.stored import StoredCalibration

CODES = {"OK": 0, "DEGRADED": 1, "MOVED": 2}
"""Exit codes, for a script that stops a cell."""


def take(
    stored: StoredCalibration, history: History, check: MonitorCheck, test: DriftTest
) -> CheckFinding:
    """Add a check without its outliers to the history; return its verdict.

    Raises:
        StageError: Its scans are in the history, or no single change of the cell explains them.
    """
    fine, misfits = _without_misfits(stored, history, check, test)
    history.add(fine)
    history.findings.append(replace(judge(stored, history, test), set_aside=misfits))
    return history.findings[-1]


def _without_misfits(
    stored: StoredCalibration, history: History, check: MonitorCheck, test: DriftTest
) -> tuple[MonitorCheck, tuple[str, ...]]:
    """Return a check without scans of other objects, and the ids of those scans.

    Scans are removed only if most others agree that nothing moved, as a real move shows in all
    scans.

    Raises:
        StageError: No single change of the cell explains all scans of the check.
    """
    before = _before(stored, history, test)
    seen = stored.sightings(check.seen, np.zeros(len(check.seen), dtype=np.intp))
    wrong = misfits(seen, before, test)
    if not wrong.any():
        return check, ()
    # Two scans that disagree do not show which one is wrong; at most one in three may be
    fewest_scans = 3
    if fewest_scans * wrong.sum() <= len(wrong):
        fine = tuple(o for o, bad in zip(check.seen, wrong, strict=True) if not bad)
        ids = tuple(o.id for o, bad in zip(check.seen, wrong, strict=True) if bad)
        return replace(check, seen=fine), ids
    scanner = stored.estimate.transform.translation
    if not explained(before, seen, stored.estimate.about, scanner, test.daily):
        raise StageError(
            f"{check.source}: nothing is checked: no single change of scanner, flange or arm "
            f"explains its {len(wrong)} scans; inspect them and scan again, or calibrate if the "
            "scanner was moved far"
        )
    return check, ()


def _before(stored: StoredCalibration, history: History, test: DriftTest) -> Information:
    """Return the information in the calibration and the earlier checks."""
    known = stored.prior.information.after_unknown_motion(test.seasonal)
    if not history.checks:
        return known
    told = information_of(stored.sightings(*history.sightings()), test.daily)
    return known.plus(told.summed(max(len(told.matrix) - test.reference, 0), None))


def judge(stored: StoredCalibration, history: History, test: DriftTest) -> CheckFinding:
    """Return the verdict of the last check; once MOVED, it stays MOVED.

    Args:
        stored: The calibration.
        history: All checks; the last has no finding yet.
        test: Settings of the test.
    """
    sightings = stored.sightings(*history.sightings())
    checks = information_of(sightings, test.daily)
    earlier = history.findings[-1] if history.findings else None
    prior, corners = stored.prior, stored.corners
    # Later checks agree with each other, not with the calibration: a new test would find no step
    if earlier and earlier.state == "MOVED" and earlier.since is not None:
        found = moved_since(checks, prior, corners, test, earlier.since, earlier.statistic)
    else:
        found = verdict(checks, prior, corners, test)
    part, probability = _blamed(stored, checks, sightings, found, test)
    return CheckFinding(
        len(checks.matrix) - 1, found.state, found.shift, tuple(found.motion.tolist()),
        found.since, found.statistic, part, probability,
    )  # fmt: skip


def _blamed(
    stored: StoredCalibration,
    checks: Information,
    sightings: CheckSightings,
    found: DriftVerdict,
    test: DriftTest,
) -> tuple[str, float]:
    """Return the likeliest part and its probability, where something changed."""
    if found.since is None:
        return "", 0.0
    n = len(checks.matrix)
    before = stored.prior.information.plus(
        checks.summed(max(found.since - test.reference, 0), found.since)
    )
    scanner = stored.estimate.transform.translation
    parts = attribute_change(
        before, sightings.of(found.since, n), stored.estimate.about, scanner, test.daily
    )
    (suspect, probability), *_ = suspects(parts)
    # The arm's parts are named by their joints too; `suspects` has added these up
    words = {"arm": ("arm", "joint")}.get(suspect, (suspect,))
    likeliest = next(part for part in parts if part.startswith(words))
    return likeliest, probability


def require_secured(url: str, security: str | None) -> None:
    """Refuse an unencrypted connection to another machine unless the user allowed it.

    Raises:
        StageError: The server is on another machine, and no security policy is given.
    """
    host = urlsplit(url).hostname or ""
    if security is None and not is_this_machine(host):
        raise StageError(
            f"{url}: is on another machine, and the connection is not protected: give "
            "--opcua-security POLICY,MODE,CERTIFICATE,KEY, such as Basic256Sha256,SignAndEncrypt,"
            f"cert.der,key.pem, or 'none' in a separate network"
        )


def write_state(url: str, node: str, finding: CheckFinding, security: str | None = None) -> None:
    """Write OK, DEGRADED or MOVED into a text node, or 0, 1, 2 into a numeric one.

    Args:
        url: ``opc.tcp://host:port``.
        node: ``ns=2;s=flangeye``.
        finding: Finding of the last check.
        security: ``POLICY,MODE,CERTIFICATE,KEY`` as asyncua has it; ``none`` neither encrypts nor
            signs.

    Raises:
        StageError: asyncua is missing, the server does not answer, there is no such node, or the
            server is on another machine and no security policy is given.
    """
    require_secured(url, security)
    try:
        import asyncua  # noqa: F401
    except ImportError:
        raise StageError("OPC UA needs asyncua: pip install 'flangeye[opcua]'") from None
    try:
        asyncio.run(asyncio.wait_for(_write(url, node, finding, security), timeout=10))
    except Exception as error:  # asyncua, asyncio and sockets each have their own
        what = str(error) or type(error).__name__
        raise StageError(f"{url}, node '{node}': cannot be written: {what}") from None


async def _write(url: str, node: str, finding: CheckFinding, security: str | None) -> None:
    from asyncua import ua
    from asyncua.client.client import Client

    client = Client(url)
    if security not in (None, "none"):
        await client.set_security_string(security)
    async with client:
        variable = client.get_node(node)
        kind = await variable.read_data_type_as_variant_type()
        value = finding.state if kind == ua.VariantType.String else CODES[finding.state]
        await variable.write_value(ua.DataValue(ua.Variant(value, kind)))
