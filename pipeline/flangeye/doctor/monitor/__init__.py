"""Whether a stored calibration still holds, check by check: the cell's watchman."""

from __future__ import annotations

from flangeye.doctor.monitor.chart import write_chart
from flangeye.doctor.monitor.history import Check, History, as_json, only_user
from flangeye.doctor.monitor.sources import from_archive, from_arm
from flangeye.doctor.monitor.stored import StoredCalibration, stored_calibration
from flangeye.doctor.monitor.watchman import CODES, judge, take

__all__ = [
    "CODES",
    "Check",
    "History",
    "StoredCalibration",
    "as_json",
    "from_archive",
    "from_arm",
    "judge",
    "only_user",
    "stored_calibration",
    "take",
    "write_chart",
]
