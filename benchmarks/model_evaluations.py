"""What a plan asks of its model: `python benchmarks/model_evaluations.py [--models checkpoints/reproduction]`.

Rows (a state with a code or a push) of the networks h, g and f in the first plan of a scene of crossing with 3 objects,
for every method and planner of the paper's figure. The reward is dense, so that no search stops early.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.model_evaluations import count_evaluations
from cavin_pyro.reproduction.methods import METHODS, PAPER_METHODS

PARTS = ("h", "g", "f")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--models", type=Path, help="folder of METHOD-0.safetensors; by default the shipped checkpoints"
    )
    parser.add_argument("--methods", nargs="+", default=PAPER_METHODS, choices=METHODS)
    arguments = parser.parse_args()
    print(f"| method | planner | {' | '.join(PARTS)} | all |\n| --- | --- |" + " --- |" * (len(PARTS) + 1))
    for name in arguments.methods:
        for planner, options in METHODS[name].planners.items():
            own = [] if arguments.models is None else [f"checkpoint={arguments.models / f'{name}-0.safetensors'}"]
            config = compose("evaluate", "task=crossing", "reward=dense", "seed=10000", *options, *own, "output=-")
            rows = count_evaluations(config)
            counts = " | ".join(f"{rows[part]:,}" for part in PARTS)
            print(f"| {METHODS[name].label} | `{planner}` | {counts} | {sum(rows[part] for part in PARTS):,} |")


if __name__ == "__main__":
    main()
