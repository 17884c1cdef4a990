"""Tables of poses as people and programs write them: text, JSON, YAML, robot programs.

A new kind of file is a module here, and a row in :mod:`~flangeye.files.tables.read`.
"""

from flangeye.files.tables.positions import holds_positions
from flangeye.files.tables.read import KINDS, files_at, read_table
from flangeye.files.tables.table import Column, Table, number_of

__all__ = [
    "KINDS",
    "Column",
    "Table",
    "files_at",
    "holds_positions",
    "number_of",
    "read_table",
]
