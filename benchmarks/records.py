"""Files of docs/results: a row per episode or measurement, with the commit that ran it."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet

from cavin_pyro.storage.files import atomic_write

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
Record = dict[str, Any]


def commit() -> str:
    revision = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    return subprocess.run(revision, capture_output=True, text=True, check=True).stdout.strip()


def read(path: Path) -> list[Record]:
    """The rows of a file, none if there is no such file."""
    return list(pyarrow.parquet.read_table(path).to_pylist()) if path.exists() else []


def write(path: Path, rows: Sequence[Record], schema: pyarrow.Schema | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        table = pyarrow.Table.from_pylist(rows, schema=schema)
        pyarrow.parquet.write_table(table, temporary, compression="zstd", compression_level=9, use_dictionary=False)
