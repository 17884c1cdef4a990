"""Templates as jinja2 compiled them, remembered: compiling the report's is a tenth of its time."""

from __future__ import annotations

from base64 import b64decode, b64encode

from jinja2 import BytecodeCache, __version__
from jinja2.bccache import Bucket

from flangeye.files.memory import keep, recall

SORT = "templates"


class Compiled(BytecodeCache):
    """What was compiled of a text, by this jinja2 for this Python."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Fill a bucket with what is remembered; jinja2 compares text and Python."""
        known = recall(SORT, _key(bucket))
        if known is not None:
            bucket.bytecode_from_string(b64decode(known))

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Remember what a bucket holds."""
        keep(SORT, _key(bucket), b64encode(bucket.bytecode_to_string()).decode())


def _key(bucket: Bucket) -> str:
    return f"{__version__} {bucket.key} {bucket.checksum}"
