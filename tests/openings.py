"""What source code can open, load or start: found by its syntax tree, to be held against a list."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("pipeline/flangeye", "plugins/flangeye_plugins", "plugins/flangeye_emulators")

MODULES = {
    "subprocess", "multiprocessing", "pty", "runpy", "ctypes", "cffi", "pickle", "marshal",
    "shelve", "dill", "cloudpickle", "zipfile", "tarfile", "fsspec", "zipimport", "imp", "sqlite3",
    "urllib", "http", "requests", "socket", "socketserver", "websockets", "ftplib", "telnetlib",
}  # fmt: skip
"""Imported, these start, load or reach something."""

CALLS = {
    "exec", "eval", "compile", "__import__", "import_module", "load_sdk", "entry_points",
    "system", "popen", "fork", "forkpty", "posix_spawn", "startfile", "create_subprocess_exec",
    "create_subprocess_shell", "add_file", "python_command", "require_named", "find_named",
    "open_regular", "read_regular", "read_text", "read_any_text", "read_bytes", "read_image", "fromfile",
    "loadtxt", "genfromtxt", "memmap", "imread", "VideoCapture", "read_triangle_mesh",
    "read_point_cloud", "LocalCluster", "Client", "create_file_camera", "enable_device_from_file",
    "LoadLibrary", "CDLL", "dlopen", "unsafe_load", "full_load",
}  # fmt: skip
"""Called, under whatever name they were imported from."""


def openings() -> set[tuple[str, str]]:
    """Return (file, word) of everything that opens, loads or starts something."""
    files = (file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    return {
        (str(file.relative_to(ROOT)), word)
        for file in files
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        for word in _words(node)
    }


def _words(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from {alias.name.partition(".")[0] for alias in node.names} & MODULES
    elif isinstance(node, ast.ImportFrom) and node.level == 0:
        yield from {str(node.module).partition(".")[0]} & MODULES
    elif isinstance(node, ast.Call):
        yield from _called(node)


def _called(node: ast.Call) -> Iterator[str]:
    name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
    owner = ast.unparse(node.func).rpartition(".")[0]
    if name == "compile" and owner in ("re", "sre", "regex"):
        return
    if name in CALLS or (name.startswith(("exec", "spawn")) and owner == "os"):
        yield name
    elif name == "load" and owner in ("np", "numpy", "yaml", "pickle", "trimesh"):
        yield f"{owner}.load"
    elif name == "open" and (isinstance(node.func, ast.Name) or node.args or owner == "os"):
        yield "open"
