"""Runs the commands the README shows and puts their real output into it: python -m tests.readme"""

import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
SHOWN = re.compile(r"<!-- begin (flangeye .*?) -->\n(.*?)<!-- end -->", re.S)


def output_of(command: str) -> str:
    """Return what a command prints, as the README quotes it."""
    words = shlex.split(command)[1:]
    with tempfile.TemporaryDirectory() as folder:
        told = subprocess.run(
            [sys.executable, "-m", "flangeye.cli", *words, "--out", f"{folder}/run"],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
    name = words[1].rpartition("/")[2]
    text = told.stdout.replace(f"{folder}/run/", f"runs/2026-11-21T02-46-14_{name}/")
    return f"```console\n$ {command}\n{text}```\n"


def shown() -> dict[str, str]:
    """Return command -> the quote of its output in the README."""
    return dict(SHOWN.findall(README.read_text()))


if __name__ == "__main__":
    text = README.read_text()
    README.write_text(
        SHOWN.sub(lambda m: f"<!-- begin {m[1]} -->\n{output_of(m[1])}<!-- end -->", text)
    )
