"""Whether a checkpoint was trained on a dataset, by the provenance of both."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cavin_pyro.data.collection import CollectionConfig
from cavin_pyro.data.dataset import content_records, read_metadata


def compare_data(folder: Path, trained: Mapping[str, Any]) -> dict[str, Any]:
    """Whether a checkpoint was trained on a dataset, by its provenance.

    Returns:
        `folder`, `transitions`, `seed`, `fingerprint`; `same`: true or false, None where it cannot be told; `verdict`.

    Raises:
        UserError: no dataset.
    """
    records, trained_on = content_records(folder), trained.get("data")
    entries = trained_on if isinstance(trained_on, list) else []
    verdicts = [_verdict(record, record["fingerprint"], entries) for record in records]
    seeds = [record["configuration"].get("seed") for record in records]
    (same, verdict), merged = verdicts[0], len(records) > 1
    if merged:
        answers = {one for one, _ in verdicts}
        same = answers.pop() if len(answers) == 1 else None
        verdict = "; ".join(f"of seed {seed}: {said}" for seed, (_, said) in zip(seeds, verdicts, strict=True))
    return {
        "folder": str(folder),
        "transitions": read_metadata(folder)["transitions"],
        "seed": seeds if merged else seeds[0],
        "fingerprint": [record["fingerprint"] for record in records] if merged else records[0]["fingerprint"],
        "same": same,
        "verdict": verdict,
    }


def _verdict(metadata: Mapping[str, Any], fingerprint: str, entries: Sequence[Any]) -> tuple[bool | None, str]:
    entries = [entry for entry in entries if isinstance(entry, dict)]
    if not entries:
        return None, "the checkpoint does not say what it was trained on"
    wanted = metadata["configuration"]
    same_configuration = [
        entry for entry in entries if _completed(entry.get("configuration") or {}) == _completed(wanted)
    ]
    if not same_configuration:
        return False, "the model was trained on other data, on none of these episodes"
    entry = next(
        (entry for entry in same_configuration if entry.get("fingerprint") == fingerprint), same_configuration[0]
    )
    grown = (
        "" if entry.get("transitions") == metadata["transitions"] else f", of which it saw {entry.get('transitions')}"
    )
    if entry.get("fingerprint") == fingerprint:
        return True, f"the model was trained on these{grown}"
    if "fingerprint" in entry:
        return False, "collected with the configuration of the training data, but by another program: other episodes"
    unknown = "the checkpoint does not say whether the content is"
    return None, f"configuration and seed are those of the training data{grown}; {unknown}"


def _completed(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A collection's configuration, with the defaults of options that an older version did not know."""
    known, found = asdict(CollectionConfig()), configuration
    ranges = {**known["ranges"], **(found.get("ranges") or {})}
    merged = {name: found.get(name, value) for name, value in known.items() if name != "assets"}
    extra = {name: value for name, value in found.items() if name not in known}
    return json.loads(json.dumps({**extra, **merged, "ranges": ranges}))
