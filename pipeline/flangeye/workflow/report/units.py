"""SI numbers as people read them in a report: millimetres, degrees, seconds."""

import math
from collections.abc import Mapping


def millimetres(metres: float) -> str:
    """Return a length [m] in mm without its unit, to a micrometre where that is significant."""
    value = metres * 1e3
    decimals = 3 if abs(value) < 10 else 2 if abs(value) < 100 else 1
    return f"{value:z.{decimals}f}"


def rounded_mm(metres: float) -> str:
    """Return a length [m] as rounded text in mm, without the unit: 0.16."""
    value = metres * 1e3
    decimals = 1 if abs(value) >= 10 else 2 if abs(value) >= 0.1 else 3
    return f"{value:.{decimals}f}"


def degrees(radians: float) -> str:
    """Return an angle [rad] in degrees without its unit, to four decimals."""
    return f"{math.degrees(radians):z.4f}"


def duration(seconds: float) -> str:
    """Return a time [s] with the unit that suits it."""
    if seconds >= 120:
        return f"{seconds / 60:.1f} min"
    if seconds >= 1:
        return f"{seconds:.2f} s"
    return f"{seconds * 1e3:.3g} ms" if seconds >= 1e-6 else "0 ms"


def figure_name(name: str) -> str:
    """Return the name of a verification's figure in words, such as ``95 % below``."""
    words = {"p95": "95 % below", "max": "largest", "inliers": "without outliers"}
    words |= {"all": "with outliers", "explained": "within the expected error"}
    return " ".join(words.get(each, each) for each in name.split("_"))


def figure(name: str, value: float, units: Mapping[str, str] | None = None) -> str:
    """Return a verification's figure as people read it: m in mm, rad in degrees.

    Args:
        name: Name of the figure.
        value: The figure, in SI.
        units: Units that the verification declares, by figure. Without one the name decides, and
            a figure with an unknown name stays as it is.
    """
    unit = _unit_by_name(name) if units is None or name not in units else units[name]
    if unit == "rad":
        return f"{degrees(value)}\N{NO-BREAK SPACE}\N{DEGREE SIGN}"
    if unit == "m":
        return f"{millimetres(value)}\N{NO-BREAK SPACE}mm"
    if unit == "share":
        return percent(value)
    if unit == "relative":
        return f"{value * 1e6:+.0f}\N{NO-BREAK SPACE}ppm"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"


def _unit_by_name(name: str) -> str:
    angles = {"tilt", "angle", "rotation", "turn", "roll", "pitch", "yaw", "clocking"}
    lengths = {
        "rms", "median", "mean", "p95", "max", "worst", "distance", "offset", "sigma", "shift",
        "error", "limit", "spread", "slide", "translation", "x", "y", "z",
    }  # fmt: skip
    words = set(name.split("_"))
    if words & angles:
        return "rad"
    if words & lengths:
        return "m"
    if words & {"overlap", "explained", "share"}:
        return "share"
    return "relative" if name == "scale" else ""


def percent(share: float) -> str:
    """Return a share in whole percent."""
    return f"{share:.0%}"
