"""What a folder of results holds, apart from times: equal for a run that met faults and for one that met none."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

TIMES = ("date", "revision", "planning_ms", "windows_per_second")  # keys and columns; a commit may come in between


def results(folder: Path) -> dict[str, Any]:
    """The content of every file beneath a folder by its name; what TensorBoard shows counts as one file."""
    found: dict[str, Any] = {}
    for path in sorted(one for one in folder.rglob("*") if one.is_file()):
        name = str(path.relative_to(folder))
        if ".tfevents." not in name:
            found[name] = _content(path)
    for board in {one.parent for one in folder.rglob("*.tfevents.*")}:
        found[str(board.relative_to(folder))] = _scalars(board)
    return found


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """What differs between a run that met faults and an unbroken one, a line for each file."""
    said = [f"{name} is left over" for name in ours if name not in theirs]
    said += [f"{name} is missing" for name in theirs if name not in ours]
    return sorted(said + [f"{name} differs" for name in ours if name in theirs and ours[name] != theirs[name]])


def seeds(content: Any) -> list[int] | None:
    """The seeds of a table of episodes, in its order."""
    if isinstance(content, list) and content and all(isinstance(row, dict) and "seed" in row for row in content):
        return [row["seed"] for row in content]
    return None


def _content(path: Path) -> Any:
    data = path.read_bytes()
    if path.name == "log.txt":
        return "Traceback" in data.decode(errors="replace")
    if path.name == "provenance.json":  # a record of each run
        return sorted({json.dumps(_timeless(run), sort_keys=True) for run in json.loads(data)})
    if path.name == "timing.csv":
        return [row[:2] for row in csv.reader(io.StringIO(data.decode()))]
    if path.suffix == ".json":
        return _timeless(json.loads(data))
    if path.suffix == ".jsonl":
        return [_timeless(json.loads(line)) for line in data.decode().splitlines()]
    if path.suffix == ".csv":
        return [_timeless(row) for row in csv.DictReader(io.StringIO(data.decode(), newline=""))]
    if path.suffix == ".safetensors":
        return _safetensors(data)
    if path.suffix in (".txt", ".html"):
        return re.sub(r"^.*\d ms$|\d{4}-\d\d-\d\dT[\d:+]+", "*", data.decode(), flags=re.MULTILINE)
    return hashlib.sha256(data).hexdigest()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _timeless(entry) for name, entry in value.items() if name not in TIMES}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value


def _safetensors(data: bytes) -> Any:
    """The header, with what it holds as JSON read, and the digest of the weights."""
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    kept = header.get("__metadata__", {})
    for name in ("config", "provenance", "state"):
        if name in kept:
            kept[name] = _timeless(json.loads(kept[name]))
    return [header, hashlib.sha256(data[8 + size :]).hexdigest()]


def _scalars(folder: Path) -> dict[str, list[float]]:
    """What TensorBoard shows: a file that begins at a step takes the place of what earlier ones have from there on."""
    shown: dict[tuple[int, str], list[float]] = {}
    for path in sorted(folder.iterdir()):
        for event in EventFileLoader(str(path)).Load():
            if event.HasField("session_log"):
                shown = {key: value for key, value in shown.items() if key[0] < event.step}
            for value in event.summary.value:
                if value.tag not in TIMES:
                    shown.setdefault((event.step, value.tag), []).append(value.tensor.float_val[0])
    return {f"{tag} at {step}": values for (step, tag), values in sorted(shown.items())}
