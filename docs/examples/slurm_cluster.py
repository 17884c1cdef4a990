"""Workers for ``flangeye batch`` as SLURM jobs: copy this file, fit it to your site, run it.

It says the address for ``--scheduler`` and keeps the jobs until Ctrl-C. Run it where the batch is
started, on a file system that the nodes share.
"""

from __future__ import annotations

import sys
import time

import dask
from dask_jobqueue import SLURMCluster

NODES = 4
CORES = 16  # of a node; each becomes a worker of one thread

# flangeye tells the session that kills its worker from those that waited beside it.
dask.config.set({"distributed.scheduler.allowed-failures": 1000})


def cluster() -> SLURMCluster:
    """Return a scheduler here whose workers will be jobs; none is submitted yet."""
    return SLURMCluster(
        queue="compute",
        walltime="04:00:00",
        cores=CORES,
        processes=CORES,
        memory=f"{4 * CORES} GB",
        python=sys.executable,  # of the environment flangeye is in, as the nodes see it
        interface=None,  # the network that the nodes share, such as "ib0"
        local_directory="/tmp",
        log_directory="slurm-logs",
        scheduler_options={"dashboard": False},
        # On nodes that others use too, add protocol="tls://" and security=distributed.Security(…):
        # who reaches the scheduler's port without a key may run code as you.
        job_script_prologue=[
            "export OMP_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1",
            # A paused worker never goes on, and the profiler keeps 40 kB a session.
            "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False",
            "export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False",
        ],
    )


def main() -> None:
    """Submit the jobs and wait."""
    with cluster() as slurm:
        slurm.scale(jobs=NODES)
        sys.stdout.write(f"flangeye batch … --scheduler {slurm.scheduler_address}\n")
        sys.stdout.flush()
        while True:  # dask_jobqueue makes Ctrl-C a plain exit, which ends the jobs
            time.sleep(60)


if __name__ == "__main__":
    main()
