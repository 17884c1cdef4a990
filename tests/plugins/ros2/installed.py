"""The real rclpy, in an environment of its own: `make test` puts it beside the tests' Python."""

import fcntl
import itertools
import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

HERE = Path(sys.prefix) / "ros2"
"""Where `make test` installs tests/plugins/ros2/requirements.txt."""


@cache
def folder():
    return Path(os.environ.get("FLANGEYE_TESTS_ROS2", HERE))


def site():
    return next(folder().glob("lib/python3*/site-packages"))


def require():
    """Skip where the wheels cannot be had: they are for CPython 3.11 on Linux, x86-64."""
    if not (folder() / "bin" / "python").exists():
        pytest.skip(f"no ROS 2 wheels in {folder()}: make test installs them")


@cache
def libraries():
    """The wheels' libraries are where no loader looks."""
    return os.pathsep.join(sorted({str(path.parent) for path in folder().rglob("*.so*")}))


def tf2_msgs():
    """The folder in which tf2_msgs is, built once."""
    built = folder() / "tf2"
    if not built.exists():
        if shutil.which("g++") is None:
            pytest.skip("no compiler for tf2_msgs, of which there is no wheel")
        with tempfile.TemporaryDirectory(dir=folder()) as name:
            env = os.environ | {"LD_LIBRARY_PATH": libraries()}
            script = Path(__file__).with_name("tf2.py")
            subprocess.run([folder() / "bin" / "python", script, name], check=True, env=env)
            with suppress(OSError):  # another worker was faster
                (Path(name)).rename(built)
                Path(name).mkdir()
    return built


def environment(domain):
    """The environment of a sourced terminal."""
    return os.environ | {
        "LD_LIBRARY_PATH": libraries(),
        "FLANGEYE_PROGRAM_ROS2": str(folder() / "bin" / "python"),
        "FLANGEYE_TESTS_ROS2_SITE": str(site()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(domain),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[3]), str(folder() / "tf2")]),
    }


_domains = itertools.count()


def free_domain() -> int:
    """A ROS domain that no other test uses now; DDS has ports for some 200."""
    return 1 + 10 * _block()[0] + next(_domains) % 10


@cache
def _block():
    """Ten domains that are this process's alone as long as it lives, and the lock that says so."""
    for number in range(10):
        lock = (Path(tempfile.gettempdir()) / f"flangeye_tests_ros2_{number}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
        else:
            return number, lock
    pytest.fail("ten test runs use ROS 2 on this machine")
