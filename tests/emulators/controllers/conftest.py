"""A controller in simulated time for every test that wants one."""

import pytest

from tests.emulators.controllers.desk import Desk


@pytest.fixture
def desk() -> Desk:
    """A UR5e that waits for commands."""
    return Desk()
