"""``flangeye new-plugin``: write an installable package whose tests pass at once."""

import re
from pathlib import Path

from flangeye.errors import StageError
from flangeye.files.paths import VERSION
from flangeye.files.regular import write_whole
from flangeye.plugin.stage import KINDS, PARTS

TEMPLATES = Path(__file__).parent / "templates"


def kinds() -> dict[str, str]:
    """Return the kinds of plugins that can be created, with a description of each."""
    meanings = {kind: contract.meaning for kind, contract in KINDS.items()} | {
        kind: part.meaning for kind, part in PARTS.items()
    }
    written = {path.name.partition(".")[0] for path in (TEMPLATES / "kinds").iterdir()}
    return {kind: meaning for kind, meaning in meanings.items() if kind in written}


def write_plugin(name: str, kind: str, into: Path) -> Path:
    """Write a package and return its folder.

    Args:
        name: Name of package and plugin, ``KIND.NAME``: lower case, words joined by ``_``.
        kind: One of :func:`kinds`.
        into: Folder in which the package's own folder is made.

    Raises:
        StageError: The name or the kind cannot be used, or the folder is there already.
    """
    _require_usable(name, kind)
    folder = into / f"flangeye-{name.replace('_', '-')}"
    if folder.exists():
        raise StageError(f"{folder} exists already; remove it, or choose another name")
    for path, text in _files(name, kind).items():
        file = folder / path
        write_whole(file, text)
    return folder


def _require_usable(name: str, kind: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name):
        raise StageError(
            f"'{name}' cannot be a plugin's name: lower-case letters and digits, words joined by "
            "_, for example acme_hull"
        )
    if kind not in kinds():
        raise StageError(f"no kind '{kind}'; kinds: {', '.join(kinds())}")


def _files(name: str, kind: str) -> dict[str, str]:
    """Return the package's files: path -> text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), undefined=StrictUndefined, keep_trailing_newline=True,
        autoescape=False,  # these are Python and TOML
    )  # fmt: skip
    values = {
        "name": name,
        "kind": kind,
        "package": f"flangeye_{name}",
        "distribution": f"flangeye-{name.replace('_', '-')}",
        "title": "".join(word.capitalize() for word in name.split("_")),
        "attribute": "stage" if kind in KINDS else "part",
        "version": ".".join(VERSION.split(".")[:2]),
    }
    templates = {
        "pyproject.toml": "pyproject.toml.j2",
        "README.md": "README.md.j2",
        f"src/{values['package']}/__init__.py": "plugin.py.j2",
        f"src/{values['package']}/{kind}.py": f"kinds/{kind}.py.j2",
        f"tests/test_{name}.py": "tests.py.j2",
    }
    return {p: environment.get_template(t).render(values) for p, t in templates.items()}
