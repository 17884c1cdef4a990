"""The outputs in the README are what the commands print."""

import pytest

from tests.readme import output_of, shown


def test_the_real_recordings(ancorasir):
    (command,) = [c for c in shown() if "aubo" in c]
    assert shown()[command] == output_of(command), "python -m tests.readme renews it"


@pytest.mark.slow
def test_the_demo():
    (command,) = [c for c in shown() if "simulated" in c]
    assert shown()[command] == output_of(command), "python -m tests.readme renews it"
