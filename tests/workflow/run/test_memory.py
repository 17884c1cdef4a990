"""A run that is given little memory ends in words, wherever it runs out."""

import resource
import subprocess
from pathlib import Path

import pytest

from flangeye.cli import console
from flangeye.files.processes import python_command, require_memory
from flangeye.workflow.log.read import read_run


@pytest.mark.parametrize("megabytes", [320, 400, 450, 470])
def test_a_run_out_of_memory_says_so_and_keeps_its_log(megabytes: int, tmp_path: Path) -> None:
    def bounded() -> None:  # at 450 OpenBLAS once tried without an end
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 1_000_000,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (60, 60))  # it takes 3 s

    words = ("-m", "flangeye.cli", "run", "ur5_phoxi-m_sample", "--out", str(tmp_path / "out"))
    done = subprocess.run(
        python_command(*words), preexec_fn=bounded, capture_output=True, text=True, check=False
    )
    *_, last = done.stderr.splitlines()
    assert (done.returncode, last[:25]) == (2, "error: not enough memory:"), done.stderr
    assert "mistake in the plugin" not in done.stderr
    assert "Traceback" not in done.stderr
    log = read_run(tmp_path / "out" / "run.mcap")
    assert not log.damage
    assert log.result is None


def test_memory_that_cannot_be_given_is_said_with_what_needs_it() -> None:
    require_memory("a little")
    with pytest.raises(MemoryError, match=r"^too much; fewer than 1073741824 MB are left$"):
        require_memory("too much", 1 << 30)


@pytest.mark.parametrize("megabytes", [120, 200])
def test_a_command_without_room_for_its_libraries_says_so_in_one_line(megabytes: int) -> None:
    def bounded() -> None:  # at 200 one of them once tried without an end
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 1_000_000,) * 2)

    done = subprocess.run(
        python_command("-m", "flangeye.cli", "check", "ur5_phoxi-m_sample"),
        preexec_fn=bounded, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: not enough memory:")


@pytest.mark.parametrize("megabytes", [430, 900])
def test_a_batch_without_room_for_its_workers_says_so_in_one_line(
    megabytes: int, tmp_path: Path
) -> None:
    def bounded() -> None:  # at 430 a worker once did not start, and was waited for
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 1_000_000,) * 2)

    words = ("batch", "ur5_phoxi-m_simulated", "--repeat", "2", "--workers", "1")
    done = subprocess.run(
        python_command("-m", "flangeye.cli", *words, "--out", str(tmp_path / "out")),
        preexec_fn=bounded, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("error: not enough memory: a batch's workers need it; fewer than")


@pytest.mark.parametrize("plenty", [True, False])
@pytest.mark.parametrize(
    "error",
    [
        ImportError("libarrow.so: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
        SystemError("error return without exception set"),
    ],
)
def test_what_a_library_says_without_memory_is_said_to_be_that(
    error: Exception, plenty: bool, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    said: list[str] = []

    def required(what: str, megabytes: int = 256) -> None:
        said.append(what)
        if len(said) > 1 and not plenty:
            raise MemoryError(f"{what}; fewer than 256 MB are left")

    def command() -> None:
        raise error

    monkeypatch.setattr(console, "require_memory", required)
    with pytest.raises(type(error) if plenty else SystemExit):
        console.report_errors(command)
    told = capsys.readouterr().err
    expected = f"error: not enough memory: {type(error).__name__}: {error}; fewer than 256 MB are"
    assert told == "" if plenty else told.startswith(expected)
