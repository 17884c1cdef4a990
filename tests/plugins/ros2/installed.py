"""The real rclpy, in an environment of its own: `make test` puts it beside the tests' Python."""

import os
import sys
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


def environment(domain):
    """The environment of a sourced terminal; the wheels' libraries are where no loader looks."""
    libraries = sorted({str(path.parent) for path in folder().rglob("*.so*")})
    return os.environ | {
        "LD_LIBRARY_PATH": os.pathsep.join(libraries),
        "FLANGEYE_PROGRAM_ROS2": str(folder() / "bin" / "python"),
        "FLANGEYE_TESTS_ROS2_SITE": str(site()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(domain),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "PYTHONPATH": str(Path(__file__).parents[3]),
    }
