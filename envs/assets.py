"""The user's folder of meshes, of which some robots and object sets are made."""

from __future__ import annotations

import os
from pathlib import Path


def assets_folder(assets: str | Path) -> Path:
    """The folder that a user has named. A `~` at the beginning is a home: no shell expands it in `env.assets=~/x`."""
    return Path(os.path.expanduser(assets))  # unlike Path.expanduser, it leaves the home of an unknown user as it is
