"""The result that a log holds."""

from __future__ import annotations

from pydantic import ValidationError

from flangeye.log.read import RunLog
from flangeye.log.records import reason_of
from flangeye.result.contract import Result


def logged_result(log: RunLog) -> Result | None:
    """Return the result of a log; None when the run did not come to its end.

    One that is no result is counted among the log's damage, and not given.
    """
    if log.result is None:
        return None
    try:
        return Result.model_validate(log.result)
    except ValidationError as error:
        del log.attachments["result.json"]
        log.damage.append(f"the attached result.json: {reason_of(error)}")
        return None
