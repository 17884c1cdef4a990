"""``flangeye doctor``: names what is wrong with an archive, instead of giving a bad number."""

from flangeye.doctor.cells import examine_cell
from flangeye.doctor.examine import Diagnosis, examine
from flangeye.doctor.opening import open_cell, open_session
from flangeye.doctor.text import as_json, as_text, fix_lines

__all__ = [
    "Diagnosis",
    "as_json",
    "as_text",
    "examine",
    "examine_cell",
    "fix_lines",
    "open_cell",
    "open_session",
]
