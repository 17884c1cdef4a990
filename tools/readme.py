"""Makes the README's console block and its picture from one run: python -m tools.readme"""

import hashlib
import math
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PICTURE = ROOT / "pipeline" / "images" / "report.png"
NUMBER = re.compile(r" *-?\b\d+(?:\.\d+)?\b")
SHOWN = re.compile(r"<!-- begin (flangeye .*?) -->\n(.*?)<!-- end -->", re.S)


STAMP = "flangeye"
"""Key of the PNG text that holds :func:`stamp`."""


def output_of(command: str, picture: Path | None = None) -> str:
    """Return a command's output as quoted in the README; optionally take a picture of its report."""
    words = shlex.split(command)[1:]
    run = words[words.index("--out") + 1]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "flangeye.cli", *words],
            cwd=folder, capture_output=True, text=True, check=True,
        )  # fmt: skip
        quote = f"```console\n$ {command}\n{done.stdout}```\n"
        if picture:
            photograph(Path(folder, run, "report.html"), picture, stamp(quote))
    return quote


def stamp(quote: str) -> str:
    """Return a hash of everything that the picture depends on: output and report code."""
    drawn = ("report.html.j2", "report.css", "report.js", "look.py", "summary.py", "still.py")
    texts = [(ROOT / "pipeline/flangeye/workflow/report" / name).read_text() for name in drawn]
    return hashlib.sha256("".join([quote, *texts]).encode()).hexdigest()


def photograph(page: Path, picture: Path, text: str) -> None:
    """Write a browser's picture of a page as PNG, with an embedded text."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        tab = browser.new_page(viewport={"width": 1280, "height": 1280})
        tab.goto(page.as_uri())
        tab.wait_for_timeout(3000)  # plots are drawn after the page has loaded
        tab.screenshot(path=picture, timeout=180e3)  # ms; drawn without a graphics card
        browser.close()
    info = PngInfo()
    info.add_text(STAMP, text)
    with Image.open(picture) as drawn:
        drawn.convert("P", palette=Image.Palette.ADAPTIVE).save(
            picture, pnginfo=info, optimize=True
        )


def shown() -> dict[str, str]:
    """Return command -> the quote of its output in the README."""
    return dict(SHOWN.findall(README.read_text()))


def same(shown: str, printed: str) -> bool:
    """Return whether two outputs are equal except for the last digits of their numbers.

    Linear algebra rounds differently on different processors, and a fit with a stopping tolerance
    amplifies that to the fourth digit. 2 % and 0.002 are more than these differences, and less than
    any change of method.
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
        SHOWN.sub(lambda m: f"<!-- begin {m[1]} -->\n{output_of(m[1], PICTURE)}<!-- end -->", text)
    )
