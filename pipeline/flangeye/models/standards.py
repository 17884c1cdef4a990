"""Flange plates of ISO 9409-1, and plates of one's own."""

from __future__ import annotations

from pydantic import Field

from flangeye.errors import RecipeError
from flangeye.files.bundled import bundled
from flangeye.files.near import nearest
from flangeye.models.model import Model, read_model
from flangeye.units import Length, param


class FlangeStandard(Model):
    """One row of ISO 9409-1: the plate's nominal dimensions. Diameters, as the standard gives."""

    designation: str
    pitch_circle: Length = param(description="d1, diameter of the circle the threads lie on.")
    outer: Length = param(description="d2, outer diameter.")
    centring: Length = param(description="d3, diameter of the centring bore.")
    threads: int = Field(ge=0, description="N, number of threaded holes.")
    thread: Length = param(description="d4, nominal diameter of the thread.")
    pin: Length = param(description="d5, diameter of the locating-pin hole on the pitch circle.")
    source: str
    verified: bool = Field(description="Whether two independent sources agree on every value.")


def load_standard(designation: str) -> FlangeStandard:
    """Return the plate with this designation; blanks, case and the leading ISO do not matter.

    Raises:
        RecipeError: It is not in the table; names the designations that are.
    """
    wanted = _designation_key(designation)
    for row in known_standards():
        if _designation_key(row.designation) == wanted:
            return row
    known = [row.designation for row in known_standards()]
    close = nearest(designation, known, n=3, cutoff=0.4) or known
    raise RecipeError(f"no flange standard '{designation}'; known: {', '.join(close)}")


def known_standards() -> tuple[FlangeStandard, ...]:
    """Return the plates of the table, smallest first."""
    return read_model(bundled("data") / "standards" / "iso9409-1.yaml", StandardTable).plates


def _designation_key(text: str) -> str:
    return text.upper().replace(" ", "").removeprefix("ISO").removeprefix("9409-1-")


class StandardTable(Model):
    """The file ``data/standards/iso9409-1.yaml``."""

    title: str
    plates: tuple[FlangeStandard, ...]
