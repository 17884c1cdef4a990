"""Drivers of arms, through their makers' client libraries."""

import pytest

pytest.register_assert_rewrite("tests.plugins.robot.behaviour")
