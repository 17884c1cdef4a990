"""Input that is made rather than spoilt: well-formed on the outside, anything inside."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence

import numpy as np
import yaml
from hypothesis import strategies as st

UNITS = ("mm", "m", "deg", "rad", "s", "", "mm/s", "furlong")
numbers = st.one_of(
    st.integers(-(10**20), 10**20), st.floats(), st.sampled_from([1e400, -0.0, 10**400])
)
quantities = st.builds("{} {}".format, numbers, st.sampled_from(UNITS))
leaves = st.one_of(st.none(), st.booleans(), numbers, quantities, st.text(max_size=20))
KEYS = ("title", "robot", "model", "urdf", "scanner", "name", "range", "driver", "limits", "box",
        "centre", "size", "feature", "standard", "configuration", "steps", "seed", "joints", "view")  # fmt: skip
keys = st.one_of(st.sampled_from(KEYS), st.text(max_size=8))
trees = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
    max_leaves=25,
)  # fmt: skip

STAGES = ("acquire.archive", "acquire.live", "segment.flange", "fit.rim", "solve.robust",
          "verify.holdout", "weld.tactile", "export.ur", "no.such")  # fmt: skip
steps = st.lists(
    st.sampled_from(STAGES) | st.dictionaries(st.sampled_from(STAGES), trees, max_size=2),
    max_size=6,
)
sections = st.fixed_dictionaries(
    {"title": leaves, "steps": steps | trees},
    optional={key: trees | st.just("ur5e") for key in KEYS if key not in ("title", "steps")},
)


def _yaml(tree: object) -> bytes:
    return yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "replace")


def _npy(shape: object, dtype: str, data: bytes) -> bytes:
    head = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data


def _ply(count: int, faces: int, kind: str, body: bytes) -> bytes:
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n"
    more = f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n"
    return f"{head}{more}end_header\n".encode() + body


def _table(rows: Sequence[Sequence[object]]) -> bytes:
    lines = ["cloud,x_m,y_m,z_m,qx,qy,qz,qw", *(",".join(map(str, row)) for row in rows)]
    return "\n".join(lines).encode("utf-8", "replace")


def _saved(values: list[float]) -> bytes:
    out = io.BytesIO()
    np.save(out, np.array(values, np.float32).reshape(-1, 3))
    return out.getvalue()


counts = st.integers(-2, 2**40)
floats = st.floats(width=32)
STRATEGIES = {
    "recipe": sections.map(_yaml),
    "model": st.dictionaries(keys, trees, max_size=8).map(_yaml),
    "set": st.builds("{}={}".format, st.lists(keys, max_size=5).map(".".join), trees).map(
        lambda text: text.encode("utf-8", "replace")
    ),
    "npy": st.builds(
        _npy, st.lists(counts | st.booleans(), max_size=4).map(tuple) | counts,
        st.sampled_from(["<f4", ">f8", "|O", "<i8", "|V8", "<U99", "<M8[s]"]), st.binary(max_size=200),
    ) | st.lists(st.tuples(floats, floats, floats), max_size=9).map(
        lambda rows: _saved([value for row in rows for value in row])
    ),
    "mesh-ply": st.builds(
        _ply, counts, counts, st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
        st.binary(max_size=200) | st.lists(numbers, max_size=30).map(lambda n: " ".join(map(str, n)).encode()),
    ),
    "poses": st.lists(st.lists(leaves, max_size=10), max_size=5).map(_table),
    "json": trees.map(lambda tree: json.dumps(tree).encode()),
}  # fmt: skip
"""For some targets, what makes their input."""
