"""Tables of poses as people and programs write them: text, documents, arrays, robot programs.

A new kind of file is a function in :mod:`~flangeye.files.tables.documents` and its row there, or a
pattern in :data:`~flangeye.maths.pose_formats.CONVENTIONS`.
"""

from flangeye.files.tables.documents import KINDS, document_of
from flangeye.files.tables.read import files_at, read_table, tables_in
from flangeye.files.tables.table import Cell, Column, Table, number_of

__all__ = [
    "KINDS",
    "Cell",
    "Column",
    "Table",
    "document_of",
    "files_at",
    "number_of",
    "read_table",
    "tables_in",
]
