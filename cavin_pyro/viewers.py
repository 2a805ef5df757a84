"""The word `viewer=`: which recordings in 3D there are, and whether what they need is installed."""

from __future__ import annotations

import importlib

from cavin_pyro.errors import UserError

VIEWERS = {"rerun": "rerun"}  # the word, and the module that it needs


def check_viewer(viewer: object) -> None:
    """Check the word, before anything is written.

    Raises:
        UserError: there is no such viewer, or what it needs is not installed.
    """
    if viewer is None:
        return
    if viewer not in VIEWERS:
        raise UserError(f"unknown viewer {viewer!r}: choose from {', '.join(VIEWERS)}, or null for none")
    try:
        importlib.import_module(VIEWERS[str(viewer)])
    except ImportError as error:
        raise UserError(
            f"viewer={viewer} needs an optional part that is not installed ({error}): "
            "run python -m pip install --constraint constraints.txt '.[viewer]' in the repository"
        ) from error
