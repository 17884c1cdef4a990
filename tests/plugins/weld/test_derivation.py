"""The derivation in plugins/flangeye_plugins/weld/README.md, equation by equation."""

from typing import Any

import numpy as np
import pytest

from flangeye_plugins.weld.following.steering import Steering

LENGTH = 40e-3


def directions(angle):
    """t and n of an angle."""
    t = np.array([np.cos(angle), np.sin(angle)])
    return t, np.array([-t[1], t[0]])


def torch(position, angle):
    """Equation (12)."""
    return position - LENGTH * directions(angle)[0]


def test_the_torch_s_velocity_is_that_of_equation_a_and_not_of_15() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        position, velocity = rng.normal(size=2), rng.normal(size=2) * 5e-3
        angle, turn, step = rng.uniform(-3, 3), rng.normal(), 1e-6
        after = torch(position + velocity * step, angle + turn * step)
        measured = (after - torch(position, angle)) / step
        _, n_d = directions(angle)
        np.testing.assert_allclose(measured, velocity - LENGTH * turn * n_d, atol=1e-6)
        assert np.abs(measured - (velocity + LENGTH * turn * n_d)).max() > 1e-4


def follow(rule, error=0.0, length=0.3):
    """Let the tip go along an S; return the torch's distance from it, from 100 mm on [m]."""

    def seam(s):
        point = np.array([s, 0.015 * np.sin(2 * np.pi * s / 0.2)])
        slope = 0.015 * 2 * np.pi / 0.2 * np.cos(2 * np.pi * s / 0.2)
        return point, np.array([1.0, slope]) / np.hypot(1.0, slope)

    s, period, speed = 0.0, 0.04, 5e-3
    start = seam(0.0)
    position, angle = start[0].copy(), np.arctan2(start[1][1], start[1][0]) + error
    off = []
    while s < length:
        point, tangent = seam(s)
        velocity = speed * tangent
        at = torch(position, angle)
        near, t_t = seam(at[0])
        n_t = np.array([-t_t[1], t_t[0]])
        # The vertical distance to the S, across it.
        e = float((at - near) @ n_t)
        turn = float(np.clip(rule(velocity, angle, t_t, n_t, e), -0.5, 0.5))
        position, angle = position + velocity * period, angle + turn * period
        s += speed * period * tangent[0]
        off.append(e)
    return np.array(off)


def corrected(gain):
    def rule(velocity, angle, t_t, n_t, e):
        tool, n_d = directions(angle)
        return (velocity @ n_t + gain * e) / (LENGTH * (n_d @ n_t))

    return rule


def printed_16(velocity, angle, t_t, n_t, e):
    """(16) with the sign of (15)."""
    _, n_d = directions(angle)
    return -(velocity @ n_t) / (LENGTH * (n_d @ n_t))


def printed_line_13(velocity, angle, t_t, n_t, e):
    t_d, n_d = directions(angle)
    along, across = (velocity @ t_d) * t_d, (velocity @ n_d) * n_d
    return -(along @ n_t + across @ t_t) / (LENGTH * (n_d @ n_t))


def late_rms(off):
    return float(np.sqrt(np.mean(off[len(off) // 2 :] ** 2)))


def test_equation_b_keeps_the_torch_on_the_path() -> None:
    assert late_rms(follow(corrected(1.0))) < 0.1e-3


def test_without_the_cross_track_term_an_initial_error_stays() -> None:
    lean = 2e-3 / LENGTH
    assert late_rms(follow(corrected(0.0), lean)) > 1e-3
    assert late_rms(follow(corrected(1.0), lean)) < 0.1e-3


@pytest.mark.parametrize("rule", [printed_16, printed_line_13])
def test_as_printed_it_diverges(rule: Any) -> None:
    assert late_rms(follow(rule)) > 5e-3


def test_the_steering_is_equation_b_where_that_is_regular() -> None:
    rng = np.random.default_rng(1)
    steering = Steering(LENGTH, 1.0, rate=10.0)
    for _ in range(20):
        angle = rng.uniform(-0.9, 0.9)
        tool, n_d = directions(angle)
        velocity, e = np.array([5e-3, rng.normal() * 1e-3]), rng.normal() * 1e-3
        normal = np.array([0.0, 1.0])
        expected = corrected(1.0)(velocity, angle, None, normal, e)
        assert steering.turn(velocity, tool, normal, e, 0.0) == pytest.approx(expected)


@pytest.mark.parametrize("degrees", np.arange(-180, 181, 15))
def test_the_turn_is_bounded_everywhere_and_turns_a_crooked_tool_back(degrees: Any) -> None:
    steering = Steering(LENGTH, 1.0, rate=0.35)
    tool, _ = directions(np.deg2rad(float(degrees)))
    turn = steering.turn(np.array([5e-3, 5e-3]), tool, np.array([0.0, 1.0]), 0.0, 0.0)
    assert abs(turn) <= 0.35
    if abs(degrees) >= 90:
        assert turn == pytest.approx(-np.copysign(0.35, tool[1]))
    pace = steering.pace(5e-3, tool, np.array([0.0, 1.0]), np.array([1.0, 0.0]))
    assert 0.1 * 5e-3 <= pace <= 5e-3
