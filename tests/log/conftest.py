"""The command line, for tests of what belongs to the log."""

from tests.cli.conftest import flangeye as flangeye_in

__all__ = ["flangeye_in"]
