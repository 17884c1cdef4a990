"""Runs the commands the README shows and puts their real output into it: python -m tools.readme"""

import math
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
NUMBER = re.compile(r" *-?\b\d+(?:\.\d+)?\b")
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


def same(shown: str, printed: str) -> bool:
    """Tell whether two outputs are equal but for the last digits of their numbers.

    Linear algebra rounds differently from one processor to the next, and a fit that stops by a
    tolerance carries that into the fourth digit: 2 % and 0.002 are more than that ever does, and
    less than what any change of method makes.
    """
    words, numbers = NUMBER.split(shown), [float(n) for n in NUMBER.findall(shown)]
    others = [float(n) for n in NUMBER.findall(printed)]
    return NUMBER.split(printed) == words and all(
        math.isclose(a, b, rel_tol=0.02, abs_tol=0.002)
        for a, b in zip(numbers, others, strict=True)
    )


if __name__ == "__main__":
    text = README.read_text()
    README.write_text(
        SHOWN.sub(lambda m: f"<!-- begin {m[1]} -->\n{output_of(m[1])}<!-- end -->", text)
    )
