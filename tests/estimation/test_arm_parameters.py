"""What is said of an arm's parameters, against arms by a generator that shares no code with ours."""

import numpy as np

from flangeye.estimation.arm_parameters import parameters_of
from flangeye.estimation.session.session import ModelOptions, Session
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT
from tests.estimation import foreign
from tests.estimation.sessions import estimated, robot


def told_of(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return by how many deviations each parameter that is identified is off, and which are."""
    arm = (foreign.UR5E, foreign.PANDA)[seed % 2]
    session = foreign.session(kind, arm, 3e-3, 40, seed)
    found = estimated(session, kind)
    cell = cell_of(DEFAULT, robot(arm["name"])[0])
    told = parameters_of(Session([], cell, None, ModelOptions(), found))
    e = session.errors
    true = np.column_stack([e.zeros, e.a, e.d, e.alpha])
    return ((told.values - true) / told.deviations)[told.identified], told.identified


def test_parameters_are_off_by_what_is_stated() -> None:
    off = np.concatenate([told_of("flange", seed)[0] for seed in range(40, 46)])
    assert len(off) > 15
    assert 0.6 < np.sqrt((off**2).mean()) < 1.5
    assert np.abs(off).max() < 4


def test_the_zero_that_turns_the_base_is_not_identified() -> None:
    """The camera's place on the base turns with it, and nobody can tell one from the other."""
    assert not any(told_of(kind, 41)[1][0, 0] for kind in ("flange", "marker"))
