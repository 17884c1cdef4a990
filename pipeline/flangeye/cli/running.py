"""Commands that run recipes: ``run``, ``batch`` and ``regress``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from flangeye.cli.app import Overrides, RecipeName, app, load_plugins, read_recipe
from flangeye.cli.console import as_damage, progress_bar, say, say_notes
from flangeye.errors import FlangeyeError, NothingMoved, StageError

if TYPE_CHECKING:
    from flangeye.plugin.registry import Registry
    from flangeye.workflow.batch.outcome import Tls
    from flangeye.workflow.doctor.diagnosis import Finding
    from flangeye.workflow.recipe.load import Recipe
    from flangeye.workflow.result.contract import Result
    from flangeye.workflow.run.folder import RunFolder
    from flangeye.workflow.run.restart import FromNothing
    from flangeye.workflow.run.session import Start


RecipeOrNone = Annotated[
    str | None, typer.Argument(help="A recipe file, or the name of a bundled recipe.")
]
RecordingsArgument = Annotated[
    str | None,
    typer.Option(
        metavar="PATH|URL",
        help="Recordings to use, for recipes that start with acquire.archive; "
        "s3://, gs://, az://, https:// and zip:// are streamed.",
    ),
]
Results = Annotated[
    str | None,
    typer.Option(
        metavar="PATH|URL", help="Folder for the run's files; default runs/<time>_<recipe>."
    ),
]
Sessions = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PATH|URL]...", help="Recordings, one session each; none for simulated recipes."
    ),
]
GridOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set-grid", metavar="PATH=A,B,C", help="Run with each of these values; may be repeated."
    ),
]
FromOption = Annotated[
    Path | None,
    typer.Option("--from", metavar="RUN.MCAP", help="Take the steps before --at from this log."),
]
AtStep = Annotated[
    str | None, typer.Option(metavar="STEP", help="First step to run again, for example solve.svd.")
]
Move = Annotated[
    bool,
    typer.Option(
        "--move",
        help="Move the arm; without it, a dry run: the arm is only read, the plan checked and "
        "shown.",
    ),
]
Offline = Annotated[
    bool, typer.Option("--offline", help="Without --move: plan without connecting to the arm.")
]
PlanAsJson = Annotated[
    bool,
    typer.Option("--json", help="Without --move: print the plan of the poses as JSON and stop."),
]
Resume = Annotated[
    str | None,
    typer.Option(metavar="RUN", help="Resume a run that ended early: its folder, log or URL."),
]
Retake = Annotated[
    list[str] | None, typer.Option(metavar="ID", help="With --resume: repeat this capture.")
]
LeaveOut = Annotated[
    list[str] | None, typer.Option(metavar="ID", help="With --from: leave out this capture.")
]


@app.command()
def run(  # noqa: PLR0913  one for each option
    recipe: RecipeOrNone = None,
    archive: RecordingsArgument = None,
    overrides: Overrides = None,
    out: Results = None,
    source: FromOption = None,
    at: AtStep = None,
    move: Move = False,
    offline: Offline = False,
    resume: Resume = None,
    retake: Retake = None,
    leave_out: LeaveOut = None,
    json_: PlanAsJson = False,
) -> None:
    """Run a recipe: a calibration, its log and its report."""
    from flangeye.devices import MotionAllowed
    from flangeye.files.remote import archive_at, results_at
    from flangeye.types import ArchivePath
    from flangeye.workflow.run.folder import RunFolder
    from flangeye.workflow.run.session import Start

    _refuse(move and offline, "--move and --offline: leave out one; --offline connects to no arm")
    _refuse(move and json_, "--move and --json: only the plan is printed as JSON")
    lonely = (retake and not resume) or (leave_out and not source)
    _refuse(lonely, "--retake goes with --resume RUN, --leave-out with --from RUN.MCAP --at STEP")
    registry = load_plugins()
    with ExitStack() as stack:
        earlier = stack.enter_context(archive_at(resume))
        checked, point = _recipe_of(recipe, (earlier, retake or ()), registry, overrides or ())
        _refuse(
            json_ and not checked.plans,
            f"--json: {checked.steps[0].stage.name} plans no poses; acquire.live and "
            "acquire.simulated do",
        )
        point = point or _point(checked, source, at, leave_out or ())
        results = stack.enter_context(results_at(out))
        recordings = stack.enter_context(archive_at(archive))
        start = Start(ArchivePath(recordings), point, MotionAllowed(move, offline, json_))
        # Last, so that a wrong recipe or archive leaves no empty folder
        folder = RunFolder.create(checked.name, results)
        with _plan_as_json() if json_ else nullcontext():
            result = _record(checked, recipe or checked.name, registry, folder, start)
        if result.status == "refused":
            _explain_refusal(folder.log, registry, result, checked, recipe or checked.name)
    if result.status == "refused" or (result.weld and not result.weld.completed):
        raise typer.Exit(1)


@contextmanager
def _plan_as_json() -> Iterator[None]:
    """Turn the plan that is shown instead of a motion into JSON: its text and its rows."""
    try:
        yield
    except NothingMoved as shown:
        raise NothingMoved(json.dumps({"text": str(shown), **(shown.plan or {})})) from None


def _refuse(options: object, why: str) -> None:

    if options:
        raise StageError(why)


def _explain_refusal(
    log: Path, registry: Registry, result: Result, recipe: Recipe, called: str
) -> None:
    """Print a refusal in three parts: what is wrong, how it is known, and the next step."""
    from rich.console import Console

    from flangeye.cli.summary import print_refusal
    from flangeye.files.remote import with_urls
    from flangeye.workflow.doctor import combined_fix
    from flangeye.workflow.log.read import read_run
    from flangeye.workflow.run.outlook import motions_to_add

    wrong, advice = str(result.refused), result.advice
    passed = {step: found.passed for step, found in result.verifications.items()}
    names = [step.stage.name for step in recipe.steps]
    verifies = [i for i, name in enumerate(names) if name.startswith("verify.")]
    after = names[verifies[-1] + 1 :] if verifies else []
    # A verification that refuses without a result leaves fewer results than there are verifications
    if after and len(passed) == len(verifies) and all(passed.values()):
        again = f"flangeye run {quote(called)} --from {quote(str(log))} --at {after[0]}"
        steps = [*filter(None, (advice, with_urls(again)))]
        known = "this step's own measurement; the calibration itself passed its verification"
        print_refusal(Console(), wrong, known, steps, "then")
        return
    findings, known = _findings(log, registry, recipe)
    errors = with_urls(f"list each pose's error: flangeye show {quote(str(log.parent))} --outlook")
    if findings:
        named, tried, steps = combined_fix(findings)
        print_refusal(Console(), named, tried or wrong, [*filter(None, steps)] or [errors])
        return
    if failed := [step for step, good in passed.items() if not good]:
        known = f"{' and '.join(failed)} failed; {known}"
    motions = [] if advice else motions_to_add(read_run(log), registry)
    print_refusal(Console(), wrong, known, [next(filter(None, (advice, *motions, errors)))])


def _findings(log: Path, registry: Registry, recipe: Recipe) -> tuple[Sequence[Finding], str]:
    """Return the mistakes that the doctor finds in a run, and why there are none.

    The mistake that explains most comes first.
    """
    from flangeye.workflow.doctor.opening import examined

    try:
        with (
            as_damage(log, "it cannot be examined"),
            progress_bar("looking for the mistake", len(registry.of_kind("check"))) as checked,
        ):
            found = examined(log, registry, recipe, checked).findings
    except FlangeyeError as error:  # the log has too little for the doctor
        return (), str(error)
    return found, "no mistake was recognised in poses or scans"


def _recipe_of(
    name: str | None,
    going_on: tuple[Path | None, Sequence[str]],
    registry: Registry,
    overrides: Sequence[str],
) -> tuple[Recipe, FromNothing | None]:
    """Return the checked recipe, by name or from the run to resume, and the run to resume."""
    from flangeye.workflow.run.restart import earlier_run

    resume, retake = going_on
    if (name is None) == (resume is None):
        raise StageError("name a recipe, or --resume RUN, which brings its own")
    if resume is not None:
        if overrides:
            raise StageError("--set and --resume: a resumed run keeps the recipe it started with")
        return earlier_run(resume, registry, retake)
    return read_recipe(str(name), registry, overrides), None


def _point(
    recipe: Recipe, source: Path | None, at: str | None, leave_out: Sequence[str]
) -> FromNothing:
    from flangeye.workflow.log.read import read_run
    from flangeye.workflow.run.restart import FromNothing, restart_at

    if (source is None) != (at is None):
        raise StageError("--from and --at go together: --from run.mcap --at solve.svd")
    if source is None or at is None:
        return FromNothing()
    log = read_run(source)
    say_notes(log.notes)
    if not log.gathered:
        raise StageError(f"{log.path}: holds no captures, so there is nothing to run on")
    return restart_at(log, recipe, at, leave_out)


def _record(
    recipe: Recipe, called: str, registry: Registry, folder: RunFolder, start: Start
) -> Result:
    """Run with a log and a progress bar, and print the result."""
    from rich.console import Console

    from flangeye.cli.summary import RunProgress, print_summary
    from flangeye.files.remote import with_urls
    from flangeye.workflow.run.session import record_run

    try:
        labels = [step.label for step in recipe.steps]
        opening = recipe.archive is not None
        with RunProgress(Console(stderr=True), labels, opening) as progress:
            registry.hooks.register(progress)
            result = record_run(recipe, registry, folder, start)
    except FlangeyeError as error:
        if folder.log.exists():
            _say_how_to_go_on(recipe, called, folder, start)
            if isinstance(error, StageError):
                _name_mistake(recipe, called, registry, folder, start)
        raise
    run = with_urls(quote(str(folder.path)))
    print_summary(Console(), result, run, len(registry.exports()), progress.said)
    return result


def _say_how_to_go_on(recipe: Recipe, called: str, folder: RunFolder, start: Start) -> None:
    """Print where the captures of a failed run are, and the commands that use them."""
    from flangeye.files.remote import with_urls
    from flangeye.workflow.run.restart import restart_hint, resumable

    seen = f"flangeye report {quote(str(folder.path))} shows it"
    lines = [
        f"the captures recorded so far are in {folder.log}; {seen}",
        f"with other parameters: {restart_hint(recipe, called, folder.log)}",
    ]
    if resumable(recipe):
        moving = " --move" if start.motion.allowed else ""
        lines.append(f"resume it: flangeye run --resume {folder.path}{moving}")
    for line in lines:
        say(with_urls(line), err=True)


def _name_mistake(
    recipe: Recipe, called: str, registry: Registry, folder: RunFolder, start: Start
) -> None:
    """Print what is wrong with unusable recordings, or the command that looks for it."""
    from rich.console import Console

    from flangeye.cli.summary import print_refusal
    from flangeye.files.remote import with_urls
    from flangeye.workflow.doctor import combined_fix

    if (read := start.archive.path or recipe.archive) is None:
        return
    findings, _ = _findings(folder.log, registry, recipe)
    if findings:
        print_refusal(Console(stderr=True), *combined_fix(findings))
    else:
        doctor = f"flangeye doctor {quote(str(read))} --recipe {quote(called)}"
        say(with_urls(f"{doctor} looks for a mistake"), err=True)


def _tls(ca: Path | None, cert: Path | None, key: Path | None) -> Tls | None:
    from flangeye.workflow.batch.outcome import BatchError, Tls

    if ca is None and cert is None and key is None:
        return None
    if ca is None or cert is None or key is None:
        raise BatchError("--tls-ca, --tls-cert and --tls-key go together")
    return Tls(ca, cert, key)


@app.command()
def batch(  # noqa: PLR0913  one argument an option
    recipe: RecipeName,
    archives: Sessions = None,
    overrides: Overrides = None,
    grid: GridOption = None,
    repeat: Annotated[
        int | None, typer.Option(min=1, max=10_000_000, help="Number of seeds to run.")
    ] = None,
    vary: Annotated[str, typer.Option(help="Value that --repeat increments.")] = "seed",
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Worker processes on this machine; default one per core."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tls://HOST:PORT", help="Use a running dask scheduler instead."),
    ] = None,
    tls_ca: Annotated[
        Path | None, typer.Option(help="CA certificate (PEM) of the scheduler and of this client.")
    ] = None,
    tls_cert: Annotated[Path | None, typer.Option(help="Client certificate (PEM).")] = None,
    tls_key: Annotated[
        Path | None, typer.Option(help="Client key (PEM); whoever has it can use the workers.")
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(metavar="PATH|URL", help="Output folder; default batches/<recipe>."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write report.html for each session.")
    ] = True,
) -> None:
    """Run a recipe over many archives, values and seeds.

    Finished sessions are not run again. Exit codes: 0 every session gave a calibration, 1 one
    was refused, failed or crashed, 2 nothing could start.
    """
    from rich.console import Console

    from flangeye.workflow.batch import Request, run_batch, summary_text

    request = Request(
        recipe, tuple(archives or ()), tuple(overrides or ()), tuple(grid or ()), repeat, vary,
        workers, scheduler, _tls(tls_ca, tls_cert, tls_key), out, report,
    )  # fmt: skip
    try:
        done = run_batch(request, load_plugins(), Console(stderr=True))
    except KeyboardInterrupt:
        sys.stderr.write("stopped; run the same command again to continue\n")
        raise typer.Exit(130) from None
    say(summary_text(done))
    if not done.accepted:
        raise typer.Exit(1)


@app.command()
def regress(
    folder: Annotated[
        Path | None, typer.Argument(help="Folder of manifests; default the bundled ones.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Worker processes on this machine; default one per core."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Output folder.")] = Path("regressions"),
) -> None:
    """Run known recordings and compare with expectations.

    A manifest says where a recording is, how to read it and what to expect; missing
    recordings are reported as skipped. Exit codes: 0 all as expected, 1 one differs,
    2 a manifest is wrong.
    """
    from rich.console import Console

    from flangeye.files.paths import bundled
    from flangeye.workflow.batch.regress import compare, read_manifests

    manifests = read_manifests(folder or bundled("data") / "manifests")
    comparisons = compare(manifests, out, workers, load_plugins(), Console(stderr=True))
    for comparison in comparisons:
        say(comparison.line())
    if any(comparison.verdict == "DIFFERS" for comparison in comparisons):
        raise typer.Exit(1)
