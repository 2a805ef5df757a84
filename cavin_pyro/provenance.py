"""Where a result comes from: command, date, versions and machine, to be kept beside it."""

from __future__ import annotations

import datetime
import hashlib
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cavin_pyro import __version__
from cavin_pyro.checkpoint import load_checkpoint
from cavin_pyro.command import PACKAGES
from cavin_pyro.dataset import content_mark, read_metadata
from cavin_pyro.windows import WindowTable


def provenance() -> dict[str, Any]:
    """A record of this run, JSON-ready."""
    return {
        "program": f"cavin_pyro {__version__}",
        "revision": _revision(),
        "command": " ".join(["python -m", _module(), *(shlex.quote(word) for word in sys.argv[1:])]),
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in ("torch", "pyro-ppl", "numpy", "pybullet", "gymnasium")},
        "machine": f"{platform.system()} {platform.machine()}",
    }


def training_provenance(data: Sequence[Path], pointnet: Path, windows: WindowTable) -> dict[str, Any]:
    """The same for a trained model: also which data and which PointNet it was trained with."""
    trained_before = load_checkpoint(pointnet).provenance
    kept = ("transitions", "episodes", "settings", "made_by")
    return {
        **provenance(),
        "data": [
            {**{name: read_metadata(folder)[name] for name in kept}, "mark": content_mark(folder)} for folder in data
        ],
        "pointnet": trained_before.get("pointnet", trained_before),
        "training_windows": len(windows.training),
        "validation_windows": len(windows.validation),
    }


def program_mark() -> str:
    """Twelve hexadecimal digits that change when any source file of the five packages does."""
    home, digest = Path(__file__).resolve().parent.parent, hashlib.sha256()
    for package in ("cavin_pyro", *PACKAGES):
        for file in sorted((home / package).rglob("*.py")):
            digest.update(str(file.relative_to(home)).encode() + file.read_bytes())
    return digest.hexdigest()[:12]


def _module() -> str:
    return f"cavin_pyro.{Path(sys.argv[0]).stem.removeprefix('cavin-')}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


def _revision() -> str:
    """The checkout's commit, with a plus if files have changed since; empty where there is no checkout."""
    folder = Path(__file__).resolve().parent
    if not (folder.parent / ".git").exists():
        return ""
    try:
        words = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=12"]
        return subprocess.run(words, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
