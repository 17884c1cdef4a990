"""The loop keeps time, and says how."""

import gc
import time

import pytest

from flangeye_plugins.weld.execution import Clock, _undisturbed


def busy(seconds):
    began = time.thread_time()
    while time.thread_time() - began < seconds:
        pass


def test_a_clock_counts_what_a_cycle_computes_and_nothing_else() -> None:
    clock = Clock()
    busy(5e-3)
    clock.start()
    assert clock.period >= 5e-3
    busy(2e-3)
    with clock.aside():
        busy(20e-3)
    time.sleep(20e-3)
    busy(2e-3)
    assert 4e-3 <= clock.computing < 15e-3
    assert clock.answering >= 24e-3  # it slept
    clock.start()
    with clock.aside():
        time.sleep(50e-3)
    assert clock.computing < 2e-3
    assert clock.answering < 50e-3
    assert clock.period >= 40e-3
    clock.start()
    assert clock.answering < 50e-3


def test_garbage_is_not_collected_in_the_loop_and_is_again_after_it() -> None:
    assert gc.isenabled()
    with pytest.raises(KeyboardInterrupt), _undisturbed():
        assert not gc.isenabled()
        raise KeyboardInterrupt
    assert gc.isenabled()
    gc.disable()
    try:
        with _undisturbed():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
