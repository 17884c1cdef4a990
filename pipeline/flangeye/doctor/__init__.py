"""``flangeye doctor``: names what is wrong with an archive, instead of giving a bad number."""

from flangeye.doctor.examine import Diagnosis, examine
from flangeye.doctor.opening import open_session
from flangeye.doctor.text import as_json, as_text, fix_lines

__all__ = ["Diagnosis", "as_json", "as_text", "examine", "fix_lines", "open_session"]
