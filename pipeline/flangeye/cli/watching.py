"""Commands to monitor a calibration, and the local page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flangeye.cli.app import Overrides, app, load_plugins
from flangeye.cli.console import say

if TYPE_CHECKING:
    from flangeye.plugin.registry import Registry
    from flangeye.workflow.doctor.monitor.drift import DriftTest
    from flangeye.workflow.doctor.monitor.history import MonitorCheck
    from flangeye.workflow.doctor.monitor.stored import StoredCalibration

Later = Annotated[
    list[Path] | None,
    typer.Option(help="Later scans that show the flange, one check per file, oldest first."),
]
More = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[NEW]...", help="Later scans too, as with --archive."),
]
Move = Annotated[
    bool, typer.Option("--move", help="Move the arm; without it, a dry run that prints the plan.")
]
HistoryFile = Annotated[
    Path | None,
    typer.Option(help="History file; default monitor.jsonl beside the calibration's log."),
]
FalseAlarms = Annotated[
    float, typer.Option(min=1e-9, max=0.05, help="Probability of a false alarm per check.")
]
Limit = Annotated[str, typer.Option(help="Smallest slow drift reported as MOVED.")]
OpcUa = Annotated[
    str | None, typer.Option(metavar="URL,NODE", help="Write the state to an OPC UA node.")
]
OpcUaSecurity = Annotated[
    str | None,
    typer.Option(
        metavar="POLICY,MODE,CERTIFICATE,KEY",
        help="OPC UA security for a server on another machine; none for an open connection.",
    ),
]


@app.command()
def monitor(  # noqa: PLR0913  one argument an option
    calibration: Annotated[
        Path,
        typer.Argument(help="The calibration: its run's folder, run.mcap or calibration.yaml."),
    ],
    archive: Later = None,
    more: More = None,
    live: Annotated[
        bool, typer.Option("--live", help="Take new scans with the recipe's arm and scanner.")
    ] = False,
    scans: Annotated[int, typer.Option(min=1, help="Number of scans with --live.")] = 3,
    move: Move = False,
    overrides: Overrides = None,
    history: HistoryFile = None,
    false_alarms: FalseAlarms = 2e-4,
    limit: Limit = "0.4 mm",
    opcua: OpcUa = None,
    opcua_security: OpcUaSecurity = None,
) -> None:
    """Check whether a calibration still holds.

    Prints one JSON line per check: OK, DEGRADED or MOVED, since when, and which part. Exit codes,
    by the last check: 0 OK, 1 DEGRADED, 2 MOVED or nothing could be checked: a script that stops
    the cell on 2 is safe either way.
    """
    from flangeye.errors import StageError
    from flangeye.workflow.doctor.monitor.chart import write_chart
    from flangeye.workflow.doctor.monitor.history import History, as_json, history_beside, only_user
    from flangeye.workflow.doctor.monitor.stored import stored_calibration
    from flangeye.workflow.doctor.monitor.verdicts import CODES, take, write_state

    archive = [*(archive or ()), *(more or ())]
    if live == bool(archive):
        raise StageError("name later scans with --archive, or let the arm take them with --live")
    test = _drift_test(false_alarms, limit)
    url, node = _opcua_node(opcua, opcua_security) if opcua else ("", "")
    stored = stored_calibration(calibration)
    place = history or history_beside(stored.path)
    # A damaged history is refused before the arm moves
    kept = History.read(place, stored.key)
    registry = load_plugins()
    for check in _checks(stored, registry, archive, (scans, move), overrides or ()):
        with only_user(place):
            # Again, under the lock: another program may have added a check
            kept = History.read(place, stored.key)
            finding = take(stored, kept, check, test)
            kept.write()
        say(as_json(kept, finding, stored.simulated))
    if opcua:  # before the chart: a disk that is full keeps no cell going
        write_state(url, node, kept.findings[-1], opcua_security)
    write_chart(kept, test, kept.path.with_suffix(".html"), stored.simulated)
    raise typer.Exit(CODES[kept.findings[-1].state])


def _drift_test(false_alarms: float, limit: str) -> DriftTest:
    from flangeye.errors import StageError
    from flangeye.units import parse_quantity
    from flangeye.workflow.doctor.monitor.drift import DriftTest

    try:
        return DriftTest(false_alarms=false_alarms, limit=parse_quantity(limit, "length"))
    except ValueError as error:
        raise StageError(f"--limit: {error}") from None


def _checks(
    stored: StoredCalibration,
    registry: Registry,
    archives: list[Path],
    live: tuple[int, bool],
    overrides: Sequence[str],
) -> Iterator[MonitorCheck]:
    from flangeye.workflow.doctor.monitor import from_archive, from_arm

    for path in archives:
        yield from_archive(path, stored, registry, overrides)
    if not archives:
        yield from_arm(stored, registry, *live, overrides)


def _opcua_node(opcua: str, security: str | None) -> tuple[str, str]:
    from flangeye.errors import StageError
    from flangeye.workflow.doctor.monitor.verdicts import require_secured

    url, comma, node = opcua.partition(",")
    if not comma:
        raise StageError(f"--opcua {opcua}: give URL,NODE: opc.tcp://plc:4840,ns=2;s=flangeye")
    require_secured(url, security)
    return url, node


@app.command("ui")
def local_page(
    folder: Annotated[Path, typer.Argument(help="Folder with recipes and runs.")] = Path(),
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.")] = 8090,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
) -> None:
    """Open the local web page: plan, run and judge."""
    from flangeye.errors import StageError

    try:
        pages = import_module("flangeye_ui")  # by name: the page is a layer above the engine
    except ModuleNotFoundError as error:
        raise StageError(f"the page needs {error.name}: pip install 'flangeye[ui]'") from None
    pages.serve(folder, load_plugins(), host, port, browser)
