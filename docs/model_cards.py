"""Write the cards of the shipped models into checkpoints/README.md: `python docs/model_cards.py [--check]`.

A card follows from the checkpoint's header, from the episodes of docs/results, and from `check.json` there, which
`--reports FOLDER` renews: it has a folder NAME for each model, to which `python -m cavin_pyro.check` wrote its report.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import pandas as pd

import cavin_pyro
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.storage.checkpoint import Checkpoint
from cavin_pyro.storage.files import atomic_write

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
REPORTS = RESULTS / "check.json"
PAGE = ROOT / "checkpoints" / "README.md"
MARKERS = re.compile(r"(<!-- cards -->\n).*(<!-- end -->)", re.DOTALL)


def card(name: str, reports: dict[str, Any]) -> str:
    """What is to be said of a shipped model."""
    trained = cavin_pyro.load(name)
    chain = [trained.provenance]
    while "initial" in chain[-1]:
        chain.append(chain[-1]["initial"]["provenance"])
    data = {one["fingerprint"]: one["transitions"] for about in chain for one in about["data"]}
    trainer, elbo = trained.config["trainer"], trained.provenance["metrics"]["validation_loss"]
    steps = f"{trainer['steps']:,} steps of {trainer['batch_size']}, rate {trainer['learning_rate']:g}"
    if len(chain) > 1:
        steps = f"{len(chain)} in turn, the last {steps}"
    lines = {
        "Program": _parts(trained),
        "Codes": ", ".join(f"{code.split('_')[0]} {_size(trained, code)}" for code in trained.model.codes) or "none",
        "Parameters": f"{_count(trained, 'model'):,} in the model, {_count(trained, 'guide'):,} in the guide",
        "Data": " and ".join(f"{count:,}" for count in data.values()) + " transitions",
        "Training": f"{steps}, {trainer['schedule']}; validation loss {elbo:.1f}",
        "Success": _success(name),
        "Check": "; ".join(f"{section} {found}" for section, found in reports.get(name, {}).items()),
    }
    return f"## {name}\n\n" + "".join(f"- {key}: {value}\n" for key, value in lines.items() if value)


def _parts(trained: Checkpoint) -> str:
    sections = ("model", "guide", "prior", "geometry", "dynamics")
    targets = [(trained.config.get(section) or {}).get("_target_") for section in sections]
    return ", ".join(f"`{target.rpartition('.')[2]}`" for target in targets if target)


def _size(trained: Checkpoint, code: str) -> int:
    size: int = getattr(trained.model, f"{code.split('_')[0]}_dimension")
    return size


def _count(trained: Checkpoint, part: str) -> int:
    return sum(value.numel() for name, value in trained.tensors.items() if name.startswith(f"{part}."))


def _success(name: str) -> str:
    """Success by the strict rules with three objects and sparse rewards; in Push-T with goals 75 steps ahead."""
    rows, planned, figure = (
        pd.read_parquet(RESULTS / f"{table}.parquet") for table in ("worlds", "success", "reproduction")
    )
    if name == "pusht":
        found = rows[
            rows["checkpoint"].str.contains("pusht-0/") & (rows["row"] == "cascade") & (rows["task"] == "75 ahead")
        ]
    elif name in set(planned["checkpoint"]):
        usual = planned["row"].isin(["ours, 3 objects", "Algorithm 1, 3 objects"]) & (planned["rules"] == "strict")
        found = planned[usual & (planned["checkpoint"] == name)]
    else:
        usual = (figure["planner"] == "paper") & (figure["objects"] == 3) & (figure["reward"] == "sparse")
        found = figure[usual & (figure["method"] == name) & (figure["training_seed"] == 1)]
        found = found.rename(columns={"strict_outcome": "outcome"})
    return "; ".join(f"{task} {_rate(own['outcome'])}" for task, own in found.groupby("task", sort=False))


def _verdicts(sections: dict[str, Any]) -> dict[str, str]:
    """The verdict of each section, and its number with the interval."""
    shown = "{level}, {mean:.3g} ({low:.3g} to {high:.3g})"
    return {name: shown.format(**one["verdict"], **one["number"]) for name, one in sections.items() if one["number"]}


def _rate(outcomes: pd.Series) -> str:
    rate = wilson(int((outcomes == "success").sum()), len(outcomes))
    return f"{100 * rate['rate']:.1f} % of {len(outcomes)} ({100 * rate['low']:.1f} to {100 * rate['high']:.1f})"


def main() -> None:
    """Write all cards, or fail where one would change."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a card would change")
    parser.add_argument("--reports", type=Path, help="folder of reports of check, one for each model")
    line = parser.parse_args()
    if line.reports:
        every = sorted(line.reports.glob("*/report.json"))
        found = {path.parent.name: _verdicts(json.loads(path.read_text())["sections"]) for path in every}
        REPORTS.write_text(json.dumps(found, indent=1) + "\n")
    reports = json.loads(REPORTS.read_text())
    before = PAGE.read_text()
    cards = "\n".join(card(file.stem, reports) for file in sorted(PAGE.parent.glob("*.safetensors")))
    after = MARKERS.sub(lambda found: f"{found[1]}\n{cards}\n{found[2]}", before)
    if line.check and after != before:
        raise SystemExit(f"{PAGE.name} would change: run python docs/model_cards.py")
    if not line.check:
        with atomic_write(PAGE) as temporary:
            temporary.write_text(after)


if __name__ == "__main__":
    main()
