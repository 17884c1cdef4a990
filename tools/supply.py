"""What the project is made of: python -m tools.supply lock|licences|weaknesses|sbom."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements.lock"
HEAD = "# Every package of `make demo` and `make test`, with hashes: python -m tools.supply lock\n"


def lock() -> None:
    """Let pip resolve what the two README commands install, and keep versions and hashes."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = ["install", "--dry-run", "--ignore-installed", "--quiet", "--report", str(report)]
        subprocess.run([sys.executable, "-m", "pip", *command, f"{ROOT}[dev]"], check=True)
        found = json.loads(report.read_text("utf-8"))["install"]
    lines = [_pinned(item) for item in found if "archive_info" in item["download_info"]]
    LOCK.write_text(HEAD + "".join(sorted(lines, key=str.lower)), encoding="utf-8")
    print(f"{LOCK.name}: {len(lines)} packages")


def _pinned(item: dict) -> str:
    what, hashes = item["metadata"], item["download_info"]["archive_info"]["hashes"]
    return f"{what['name']}=={what['version']} --hash=sha256:{hashes['sha256']}\n"


def pinned() -> dict[str, str]:
    """Return name -> version of every locked package."""
    lines = [line.split()[0] for line in LOCK.read_text("utf-8").splitlines() if "==" in line]
    return dict(line.split("==") for line in lines)


def licence_of(name: str) -> str:
    """Return what a package says of its licence; empty where it is not installed or silent."""
    try:
        facts = distribution(name).metadata
    except PackageNotFoundError:
        return ""
    classified = [
        c.rpartition(" :: ")[2] for c in facts.get_all("Classifier") or () if "License" in c
    ]
    told = facts.get("License-Expression") or "; ".join(classified) or facts.get("License") or ""
    return told.splitlines()[0][:80] if told else ""


def licences() -> None:
    """List name, version and licence."""
    for name, version in pinned().items():
        print(f"{name:32} {version:16} {licence_of(name) or 'not installed, or does not say'}")


def weaknesses() -> None:
    """Ask pip-audit; where it is missing or reaches no database, say so."""
    command = [
        sys.executable,
        "-m",
        "pip_audit",
        "--require-hashes",
        "--disable-pip",
        "-r",
        str(LOCK),
    ]
    told = subprocess.run(command, capture_output=True, text=True)
    print(told.stdout or told.stderr.strip().splitlines()[-1])
    if told.returncode and not told.stdout:
        print(
            "pip-audit is missing (pip install pip-audit) or reaches no database: nothing is known"
        )
    sys.exit(told.returncode)


def sbom() -> None:
    """Write a CycloneDX 1.6 list of components."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    own = {"type": "library", "name": project["name"], "version": project["version"]}
    document = {
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1,
        "metadata": {"component": own},
        "components": [_component(line) for line in LOCK.read_text("utf-8").splitlines() if "==" in line],
    }  # fmt: skip
    out = ROOT / "dist" / "sbom.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    print(f"{out.relative_to(ROOT)}: {len(document['components'])} components")


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
