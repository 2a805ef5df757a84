"""Provenance of a trained model: the run, its data and its geometric features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavin_pyro.data.dataset import content_fingerprint, read_metadata
from cavin_pyro.data.windows import WindowTable
from cavin_pyro.storage.provenance import provenance


def training_provenance(data: Sequence[Path], geometry: Mapping[str, Any], windows: WindowTable) -> dict[str, Any]:
    """The provenance of a trained model: the run, its data and what `geometry` says of the geometric features."""
    names = ("transitions", "episodes", "configuration", "made_by")
    return {
        **provenance(),
        "data": [
            {**{name: read_metadata(folder)[name] for name in names}, "fingerprint": content_fingerprint(folder)}
            for folder in data
        ],
        **geometry,
        "training_windows": len(windows.training),
        "validation_windows": len(windows.validation),
    }
