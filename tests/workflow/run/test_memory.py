"""A run that is given little memory ends in words, wherever it runs out."""

import resource
import subprocess
from pathlib import Path

import pytest

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
