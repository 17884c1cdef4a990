"""The simulation behind the plan of a million sessions: it is right where arithmetic is."""

import numpy as np
import pytest

from tools.plan_sessions import Cluster, Session, Site, Told

COUNT = 2000


def told(session: Session, site: Site) -> Told:
    return Cluster(COUNT, session, site, np.random.default_rng(0)).run()


def test_cores_that_wait_for_nothing_share_the_work() -> None:
    done = told(Session(1.0, 5.0, 0.0), Site(10, lost=1e-9))
    assert done.hours * 3600 == pytest.approx(COUNT * 5.0 / 10, rel=0.02)
    assert done.cores > 0.98 and done.begun_again == 0


def test_a_store_gives_no_more_than_it_can_nor_to_one_more_than_its_link() -> None:
    done = told(Session(1e9, 0.1, 0.0), Site(100, store=10e9, link=1e9))
    assert done.hours * 3600 == pytest.approx(COUNT * 1e9 / 10e9, rel=0.02)
    assert done.store == pytest.approx(1.0, abs=0.01)
    alone = told(Session(1e9, 0.1, 0.0), Site(1, store=10e9, link=1e9))
    assert alone.hours * 3600 == pytest.approx(COUNT * (1.0 + 0.1), rel=0.02)


def test_a_scheduler_serves_one_after_the_other() -> None:
    done = told(Session(1.0, 0.1, 0.01), Site(1000, lost=1e-9))
    assert done.hours * 3600 == pytest.approx(COUNT * 0.01, rel=0.02)
    assert done.scheduler > 0.98


def test_a_session_that_is_lost_begins_again() -> None:
    calm, torn = (told(Session(1.0, 10.0, 0.0), Site(10, lost=lost)) for lost in (1e-9, 36.0))
    # One in ten is lost, half way on average: e^-x dx over ten seconds of a mean of a hundred.
    assert torn.begun_again == pytest.approx(COUNT * (np.exp(0.1) - 1), rel=0.15)
    assert torn.hours > 1.03 * calm.hours
