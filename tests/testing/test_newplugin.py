"""What ``flangeye new-plugin`` writes is installed, found, and passes its own tests at once."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.errors import StageError
from flangeye.plugin.scaffold import kinds, write_plugin
from flangeye.plugin.stage import KINDS, PARTS
from flangeye.testing import KITS


def run(*words, **more):
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An interpreter of its own that sees what this one sees."""
    folder = tmp_path_factory.mktemp("venv")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    site = next(folder.glob("lib/python*/site-packages"))
    paths = [path for path in sys.path if path and path != sysconfig.get_path("stdlib")]
    (site / "outside.pth").write_text("\n".join(paths))
    return folder / "bin" / "python"


def installed(python, folders):
    command = [sys.executable, "-m", "pip", "--quiet", "--python", python, "install"]
    run(*command, "--no-deps", "--no-build-isolation", *folders)


def passed(python, folders):
    return run(
        python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:dash", "-W", "error",
        "--import-mode=importlib", "--rootdir", folders[0], *folders,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def test_there_is_a_template_and_a_kit_for_every_kind() -> None:
    assert set(kinds()) == set(KITS) == {*KINDS, *PARTS}


def test_a_new_scanner_passes_its_tests(python: Any, tmp_path: Path) -> None:
    told = CliRunner().invoke(
        commands(), ["new-plugin", "quick_eye", "--kind", "scanner", "--into", str(tmp_path)]
    )
    folder = tmp_path / "flangeye-quick-eye"
    assert told.exit_code == 0
    assert told.stdout.startswith(f"{folder}: pip install --editable")
    installed(python, [folder])
    assert " passed" in passed(python, [folder])
    listed = run(python, "-m", "flangeye.cli", "stages", "scanner.quick_eye")
    assert "exposure: duration = 50 ms" in listed
    assert "quick_eye 0.1.0: scanner.quick_eye" in run(python, "-m", "flangeye.cli", "plugins")


@pytest.mark.slow
def test_a_new_plugin_of_every_kind_passes_its_tests(python: Any, tmp_path: Path) -> None:
    folders = [write_plugin(f"new_{kind}", kind, tmp_path) for kind in kinds()]
    installed(python, folders)
    assert " passed" in passed(python, folders)


@pytest.mark.parametrize("kind", kinds())
def test_what_is_written_is_clean(kind: Any, tmp_path: Path) -> None:
    folder = write_plugin("acme", kind, tmp_path)
    run(
        sys.executable,
        "-m",
        "ruff",
        "check",
        "--no-cache",
        "--isolated",
        "--line-length",
        "100",
        "--select",
        "E,F,W,B,UP",
        folder,
    )


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        (
            "Acme Fit",
            "fit",
            "'Acme Fit' cannot be a plugin's name: lower-case letters and digits, words joined by "
            "_, for example acme_hull",
        ),
        ("acme", "camera", f"no kind 'camera'; kinds: {', '.join(kinds())}"),
    ],
)
def test_what_cannot_be_written_is_said(name: str, kind: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(StageError) as error:
        write_plugin(name, kind, tmp_path)
    assert str(error.value) == message
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_over(tmp_path: Path) -> None:
    write_plugin("acme", "fit", tmp_path)
    with pytest.raises(StageError) as error:
        write_plugin("acme", "cost", tmp_path)
    assert str(error.value) == (
        f"{tmp_path / 'flangeye-acme'} exists already; remove it, or choose another name"
    )
