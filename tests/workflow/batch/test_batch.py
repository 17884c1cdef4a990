"""Whole batches on real dask clusters."""

import csv
import fcntl
import importlib.util
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from flangeye.workflow.batch import cluster
from flangeye.workflow.batch.dataset import Dataset, Ledger, columns_of
from flangeye.workflow.batch.outcome import BatchError, Request
from flangeye.workflow.batch.plan import Software, plan, software_of
from flangeye.workflow.batch.work import READY, STARTS, WORKER_DIED, Job

SLURM = Path(__file__).parents[3] / "docs/examples/slurm_cluster.py"
PATIENCE = 120
"""Seconds after which a process is taken to hang; it answers in a few."""


def rows(folder):
    with Path(folder, "sessions.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_end_is_a_row_and_costs_only_itself(
    batch: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that is killed, too; and the second start goes on where the first ended."""
    grid = ("steps.3.what=die,work,refuse,fail,die once",)
    done, said = batch(grid=grid, overrides=("steps.3.once=once",), workers=2)
    told = [(row["steps.3.what"], row["status"]) for row in rows(done.out)]
    assert told == [
        ("die", "crashed"), ("work", "verified"), ("refuse", "refused"), ("fail", "failed"),
        ("die once", "verified"),
    ]  # fmt: skip
    assert rows(done.out)[0]["reason"] == WORKER_DIED
    assert not done.accepted
    assert f"crashed {rows(done.out)[0]['session']}: {WORKER_DIED}\n" in said
    assert done.out == "batches/toy"
    assert not Path(done.out, STARTS).exists()

    more = {"overrides": ("steps.3.once=once",), "workers": 1}
    again, _ = batch(grid=("steps.3.what=work,refuse,fail",), **more)
    assert (again.known, again.tally.total) == (2, 3)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    killed = tmp_path / f"{cluster.PREFIX}{ended.pid}-x"
    killed.mkdir()
    third, _ = batch(grid=("steps.3.what=work,refuse",), **more)
    assert not killed.exists()  # a killed batch's, though this one starts no cluster
    assert (third.known, len(rows(third.out))) == (2, 2)


def test_a_folder_in_which_another_batch_runs_is_refused_and_not_touched(
    batch: Callable[..., Any], tmp_path: Path
) -> None:
    running = tmp_path / "busy" / STARTS / "a-session"
    running.parent.mkdir(parents=True)
    running.write_bytes(b".")
    with (tmp_path / "busy" / ".lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BatchError, match="busy: another batch writes to this folder: wait"):
            batch(grid=("steps.3.what=work",), out=str(tmp_path / "busy"), workers=1)
    assert running.read_bytes() == b"."
    done, _ = batch(grid=("steps.3.what=work",), out=str(tmp_path / "busy"), workers=1)
    assert done.accepted


def test_archives_on_the_command_line(
    flangeye: Callable[..., Any], archive_recipe: Path, archives: Any, tmp_path: Path
) -> None:
    code, out, err = flangeye("batch", archive_recipe, *archives, "--workers", "1", "--out", "out")
    assert code == 1
    assert out.startswith("3 sessions: 2 verified, 1 failed\n  held-out error ")
    assert out.endswith("out/: summary.html  sessions.csv  sessions.parquet\n")
    assert f": {archives[2]}: no such archive\n" in err
    page = (tmp_path / "out" / "summary.html").read_text()
    assert "<b>" not in page
    for row in rows(tmp_path / "out")[:2]:
        assert (tmp_path / "out" / row["report"]).stat().st_size > 1000
        assert f'href="{row["report"]}"' in page
    code, out, _ = flangeye("batch", archive_recipe, *archives[:2], "--out", "out")
    assert code == 0
    assert out.startswith("2 sessions: 2 verified (2 of them finished earlier)\n")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--scheduler", "tcp://127.0.0.1:9"],
         "error: --scheduler tcp://127.0.0.1:9: no dask scheduler answers there (no answer "
         "within 0.5 s); the address is what 'dask scheduler' prints, such as tcp://host:8786"),
        (["--scheduler", "nonsense"],
         "error: --scheduler nonsense: no dask scheduler answers there (ValueError: missing port "
         "number in address 'nonsense'); the address is what 'dask scheduler' prints, such as "
         "tcp://host:8786"),
        (["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"],
         "error: --workers starts workers here, --scheduler uses others; give one"),
        (["--set-grid", "steps.7.x=1,2"],
         "error: --set-grid steps.7.x: no step '7'; steps are 0 to 4"),
        (["--out", "toy.yaml/out"], "error: toy.yaml/out: cannot be made: Not a directory"),
    ],
)  # fmt: skip
def test_what_cannot_start_leaves_nothing(
    flangeye: Callable[..., Any],
    recipe: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: list[Any],
    line: str,
) -> None:
    assert cluster.CONNECT_SECONDS == 5
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    code, _, err = flangeye("batch", recipe, *words)
    assert (code, err.splitlines()[-1]) == (2, line)
    assert "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == ["toy.yaml"]


def test_without_the_extra_it_says_what_to_install(
    flangeye: Callable[..., Any], recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(cluster, "find_spec", lambda n: None if n == "pyarrow" else find(n))
    code, _, err = flangeye("batch", recipe)
    assert code == 2
    assert err == (
        f"error: flangeye batch needs pyarrow; install with: {sys.executable} -m pip install "
        "'flangeye[batch]'\n"
    )


def test_the_command_line_does_not_import_dask() -> None:
    code = (
        "import sys; from flangeye import cli; from flangeye.workflow import batch; "
        "print([m for m in ('dask', 'distributed', 'pyarrow', 'plotly') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "[]\n"


def test_a_port_that_is_no_scheduler(
    batch: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(BatchError, match="no dask scheduler answers there"):
            batch(scheduler=address)


@contextmanager
def running(command, **options):
    """Start a command in a process group of its own, of which nothing is left at the end.

    Not in a session of its own: Linux may give each session an equal share of the processor, and
    the process would starve beside a busy test run.
    """
    pipe = subprocess.PIPE
    with subprocess.Popen(command, process_group=0, stdout=pipe, text=True, **options) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def test_ctrl_c_keeps_what_came_so_far(recipe: Path, tmp_path: Path) -> None:
    """Sent to the whole group, as a terminal does: the workers must not answer it."""
    command = [
        sys.executable, "-m", "flangeye.cli", "batch", str(recipe), "--repeat", "100",
        "--set", "steps.3.wait=100 ms", "--no-report", "--workers", "1", "--out", "out",
    ]  # fmt: skip
    with running(command, stderr=subprocess.STDOUT) as process:
        deadline = time.monotonic() + PATIENCE
        while len(list(tmp_path.glob("out/*/session.json"))) < 3:
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert said.strip() == "stopped; run the same command again to continue"
    assert 0 < len(rows(tmp_path / "out")) < 100
    assert (tmp_path / "out" / "summary.html").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="what a process has mapped is read from /proc")
def test_a_killed_group_leaves_no_semaphore() -> None:
    code = (
        "from flangeye.workflow.batch.cluster import local_client\n"
        "if __name__ == '__main__':\n"
        "    with local_client(1) as client:\n"
        "        print(*client.run(lambda: open('/proc/self/maps').read()).values())\n"
        "        print('end', flush=True)\n"
        "        input()\n"
    )
    with running([sys.executable, "-c", code], stdin=subprocess.PIPE) as process:
        told = "".join(iter(process.stdout.readline, "end\n"))
    semaphores = [Path(word) for word in told.split() if word.startswith("/dev/shm/sem.")]
    assert semaphores
    deadline = time.monotonic() + PATIENCE
    while any(path.exists() for path in semaphores):
        assert time.monotonic() < deadline
        time.sleep(0.05)


SBATCH = f"""\
#!{sys.executable}
# Stands in for SLURM: starts the job's script on this machine.
import pathlib, shutil, subprocess, sys
shutil.copy(sys.argv[1], "job.sh")
with open("job.log", "w") as log:
    job = subprocess.Popen(["sh", "job.sh"], process_group=0, stdout=log, stderr=log)
pathlib.Path("job.pid").write_text(str(job.pid))
print("Submitted batch job 1")
"""


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Run the documented script with a stand-in for SLURM; give the scheduler's address."""
    if importlib.util.find_spec("dask_jobqueue") is None:
        pytest.skip("dask-jobqueue is not installed")
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    for name, text in (("sbatch", SBATCH), ("scancel", "#!/bin/sh\nkill -- -$(cat job.pid)\n")):
        (bin_ / name).write_text(text)
        (bin_ / name).chmod(0o755)
    script = tmp_path / "slurm_cluster.py"
    text = SLURM.read_text().replace("NODES = 4", "NODES = 1").replace("CORES = 16", "CORES = 2")
    script.write_text(text.replace('"/tmp"', repr(str(tmp_path))))
    environment = {**os.environ, "PATH": f"{bin_}{os.pathsep}{os.environ['PATH']}"}
    with running([sys.executable, script], env=environment) as process:
        line = process.stdout.readline()
        yield line.split()[-1]
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 0


def test_the_slurm_script_and_a_batch_on_it(
    slurm: Any, batch: Callable[..., Any], tmp_path: Path
) -> None:
    done, _ = batch(scheduler=slurm, grid=("steps.3.what=work,die",))
    assert [row["status"] for row in rows(done.out)] == ["verified", "crashed"]
    job = (tmp_path / "job.sh").read_text()
    for line in ("#SBATCH -p compute", "#SBATCH --cpus-per-task=2", "#SBATCH -t 04:00:00"):
        assert line in job
    assert re.search(r"dask_worker tcp://\S+ .*--nthreads 1 .*--nworkers 2 ", job)


def a_job(folder: Path, software: Software) -> Job:
    """Return the job of a batch that may begin."""
    job = Job(str(folder / "out"), False, software, columns_of({}))
    job.place.write(READY, b"")
    return job


@pytest.mark.realtime
@pytest.mark.alone
def test_two_workers_are_at_work_nearly_all_the_time(
    recipe: Path, registry: Any, tmp_path: Path
) -> None:
    """Measured against the sessions' own time, so that a busy machine does not fail it."""
    software = software_of(registry)
    wanted = Request(str(recipe), repeat=26, overrides=("steps.3.wait=100 ms",))
    sessions = plan(wanted, registry, software)
    job = a_job(tmp_path, software)
    todo = list(enumerate(sessions))
    with cluster.local_client(2) as client:
        assert len(list(cluster.run_all(client, job, todo[:2], 2))) == 2  # imports everything
        begun = time.perf_counter()
        told = list(cluster.run_all(client, job, todo[2:], 24))
        took = time.perf_counter() - begun
    assert {status for each in told for status in each.counts} == {"verified"}
    rows = list(Dataset(job.place, job.columns).rows(Ledger(sessions)))
    worked = sum(row["seconds"] for row in rows[2:])
    assert len(rows) == 26
    assert worked / took > 1.8
    assert (2 * took - worked) / 24 < 0.03


@pytest.mark.slow
def test_500_sessions_keep_memory_flat(recipe: Path, registry: Any, tmp_path: Path) -> None:
    import psutil

    software = software_of(registry)
    sessions = plan(Request(str(recipe), repeat=500), registry, software)
    job = a_job(tmp_path, software)

    def resident():
        return psutil.Process().memory_info().rss

    with cluster.local_client(1) as client:
        memory: list[tuple[int, int]] = []
        done = 0
        for told in cluster.run_all(client, job, enumerate(sessions), len(sessions)):
            done += told.counts.total()
            if (not memory and done > 100) or done == len(sessions):
                (worker,) = client.run(resident).values()
                memory.append((resident(), worker))
    for early, late in zip(*memory, strict=True):
        assert late - early < 10e6


def test_files_for_tls_go_together_and_exist(batch: Callable[..., Any], tmp_path: Path) -> None:
    from flangeye.workflow.batch.outcome import Tls

    missing = Tls(tmp_path / "ca.pem", tmp_path / "cert.pem", tmp_path / "key.pem")
    with pytest.raises(
        BatchError, match=r"ca.pem: no such file; --tls-ca, --tls-cert and --tls-key"
    ):
        batch(scheduler="tls://127.0.0.1:9", tls=missing)
    with pytest.raises(BatchError, match=r"--tls-… is for a scheduler"):
        batch(tls=missing)


def test_the_local_cluster_keeps_few_messages_and_speaks_to_nobody_without_its_key() -> None:
    from distributed import Security
    from distributed.comm import connect

    from flangeye.workflow.batch.cluster import local_client

    with local_client(1) as client:
        # Each connection would keep a thousand messages, with every chunk that was sent.
        sending = [client.scheduler_comm, *client.cluster.scheduler.stream_comms.values()]
        assert len(sending) == 2 and all(s.recent_message_log.maxlen < 10 for s in sending)
        address = client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        assert client.submit(os.getpid).result(PATIENCE) > 0
        for stranger, scheme in ((Security(), "tcp"), (Security.temporary(), "tls")):
            own = stranger.get_connection_args("client")
            with pytest.raises(OSError):
                client.sync(connect, address.replace("tls", scheme), timeout=1, **own)
