"""What the project is made of: python -m tools.supply lock|licences|weaknesses|sbom."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from platform import machine, python_version, system

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements.lock"
HEAD = """\
# Every package of `make demo` and `make test`, with the hash of the file that pip chooses on
# {machine}, Python {python}: python -m tools.supply lock
"""


def lock() -> None:
    """Write versions and hashes of the packages that the README's two commands install."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = ["install", "--dry-run", "--ignore-installed", "--quiet", "--report", str(report)]
        subprocess.run([sys.executable, "-m", "pip", *command, f"{ROOT}[dev]"], check=True)
        found = json.loads(report.read_text("utf-8"))["install"]
    lines = [_pinned(item) for item in found if "archive_info" in item["download_info"]]
    head = HEAD.format(
        machine=f"{system()} {machine()}", python=python_version().rpartition(".")[0]
    )
    LOCK.write_text(head + "".join(sorted(lines, key=str.lower)), encoding="utf-8")
    print(f"{LOCK.name}: {len(lines)} packages")


def _pinned(item: dict) -> str:
    what, hashes = item["metadata"], item["download_info"]["archive_info"]["hashes"]
    return f"{what['name']}=={what['version']} --hash=sha256:{hashes['sha256']}\n"


def pinned() -> dict[str, str]:
    """Return name -> version of every locked package."""
    lines = [line.split()[0] for line in LOCK.read_text("utf-8").splitlines() if "==" in line]
    return dict(line.split("==") for line in lines)


def licence_of(name: str) -> str:
    """Return a package's licence from its metadata; empty if unknown or not installed."""
    try:
        facts = distribution(name).metadata
    except PackageNotFoundError:
        return ""
    classifiers = facts.get_all("Classifier") or ()
    classified = "; ".join(c.rpartition(" :: ")[2] for c in classifiers if "License" in c)
    expression, free = (facts.get_all(key) or [""] for key in ("License-Expression", "License"))
    told = expression[0] or classified or free[0]
    return told.splitlines()[0][:80] if told else ""


def licences() -> None:
    """List name, version and licence."""
    for name, version in pinned().items():
        print(f"{name:32} {version:16} {licence_of(name) or 'not installed, or does not say'}")


def weaknesses() -> None:
    """Check every package with pip-audit, and print the number of known vulnerabilities."""
    tool = shutil.which("pip-audit")
    if tool is None:
        sys.exit("pip-audit is not in PATH: pipx install pip-audit")
    options = ["--require-hashes", "--disable-pip", "--format=json", "--progress-spinner=off"]
    told = subprocess.run([tool, *options, "-r", str(LOCK)], capture_output=True, text=True)
    if not told.stdout:
        sys.exit(f"nothing is known: {told.stderr.strip().splitlines()[-1]}")
    every = json.loads(told.stdout)["dependencies"]
    known = [each for each in every if "skip_reason" not in each]
    weak = [(each, weakness["id"]) for each in known for weakness in each["vulns"]]
    print(f"{len(known)} of {len(every)} packages are in the database that pip-audit reaches")
    for each, name in weak:
        print(f"{each['name']} {each['version']}: {name}")
    sys.exit(bool(weak) or len(known) < len(every))


def sbom() -> None:
    """Write a CycloneDX 1.6 list of components."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    own = {"type": "library", "name": project["name"], "version": project["version"]}
    components = [_component(line) for line in LOCK.read_text("utf-8").splitlines() if "==" in line]
    document = {
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1,
        "metadata": {"component": own},
        "components": components,
    }  # fmt: skip
    out = ROOT / "dist" / "sbom.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    print(f"{out.relative_to(ROOT)}: {len(components)} components")


def _component(line: str) -> dict:
    exact, _, digest = line.partition(" --hash=sha256:")
    name, _, version = exact.partition("==")
    made = {
        "type": "library", "name": name, "version": version, "purl": f"pkg:pypi/{name.lower()}@{version}",
        "hashes": [{"alg": "SHA-256", "content": digest}],
    }  # fmt: skip
    told = licence_of(name)
    return made | ({"licenses": [{"license": {"name": told}}]} if told else {})


COMMANDS = {"lock": lock, "licences": licences, "weaknesses": weaknesses, "sbom": sbom}

if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    COMMANDS[sys.argv[1]]()
