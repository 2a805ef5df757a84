"""Provenance of a result: command, date, versions and machine."""

from __future__ import annotations

import datetime
import hashlib
import platform
import shlex
import subprocess
import sys
from contextlib import suppress
from glob import glob
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cavin_pyro import __version__

PACKAGES = ("torch", "pyro-ppl", "numpy", "pybullet", "pybullet-arm64", "gymnasium")


def provenance() -> dict[str, Any]:
    """A record of this run, JSON-ready."""
    return {
        "program": f"cavin_pyro {__version__}",
        "revision": _revision(),
        "command": shlex.join(["python", *_program(), *sys.argv[1:]]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "packages": _packages(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def program_fingerprint() -> str:
    """Twelve hexadecimal digits that change when any source file of the program does."""
    home, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for name in sorted(glob("**/*.py", root_dir=home, recursive=True)):
        digest.update(name.encode() + (home / name).read_bytes())
    return digest.hexdigest()[:12]


def _program() -> list[str]:
    """A command, or the user's own script."""
    script = Path(sys.argv[0])
    ours = script.parent.name == "cavin_pyro" or script.stem.startswith("cavin-")
    return ["-m", f"cavin_pyro.{script.stem.removeprefix('cavin-')}"] if ours else [script.name]


def _packages() -> dict[str, str]:
    """The versions of those that are installed."""
    found = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _revision() -> str:
    """The checkout's commit, with a plus if files have changed since; empty where there is no checkout."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return ""
    try:
        line = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=12"]
        return subprocess.run(line, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
