"""Makes a release: versions, changelog, wheel with its tests, commit and tag. Nothing is uploaded.

python shipping/release.py VERSION
"""

from __future__ import annotations

import re
import subprocess
import sys
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VERSIONS = {
    "pyproject.toml": r'(?m)^(version = )"[^"]+"',
    "shipping/recipe.yaml": r'(?m)^(  version: )"[^"]+"',
    "CITATION.cff": r"(?m)^(version: )\S+",
    "docs/guide/cite.md": r"(  version = )\{[^}]+\}",
}
QUOTED = {
    "pyproject.toml": '"{}"',
    "shipping/recipe.yaml": '"{}"',
    "CITATION.cff": "{}",
    "docs/guide/cite.md": "{{{}}}",
}


def write_versions(root: Path, version: str) -> None:
    """Write the version wherever one stands, and move the unreleased part of the changelog under it.

    Raises:
        ValueError: the version is not like 1.2.3, a file names no version, or nothing is unreleased.
    """
    if not re.fullmatch(r"\d+\.\d+\.\d+(?:(?:a|b|rc)\d+)?", version):
        raise ValueError(f"{version} is no version such as 1.2.3 or 1.2.3rc1")
    heading = f"## [Unreleased]\n\n## [{version}] - {date.today().isoformat()}"
    changes = {name: (pattern, rf"\g<1>{QUOTED[name].format(version)}") for name, pattern in VERSIONS.items()}
    changes["CHANGELOG.md"] = (r"(?m)^## \[Unreleased\]", heading)
    for name, (pattern, new) in changes.items():
        text, count = re.subn(pattern, new, (root / name).read_text(encoding="utf-8"), count=1)
        if not count:
            raise ValueError(f"{name} has no place for the version")
        (root / name).write_text(text, encoding="utf-8")


def main(version: str) -> None:
    """Release the checkout that this file is in."""
    if run("git", "status", "--porcelain"):
        sys.exit("commit or stash your changes first")
    write_versions(ROOT, version)
    run(sys.executable, "-m", "build", "--outdir", "dist")
    run(sys.executable, "-m", "pytest", "-q", "-m", "slow or not slow", "tests/test_packaging.py")
    run("git", "commit", "--all", "--message", f"Release {version}")
    run("git", "tag", "--annotate", f"v{version}", "--message", f"noiseflow {version}")
    print(f"dist/ holds {version}; publish it with: git push --follow-tags, and twine upload dist/*{version}*")


def run(*words: str) -> str:
    """Run a command in the checkout; returns what it printed."""
    return subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
