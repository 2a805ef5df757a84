"""Evaluate: `python -m cavin_pyro.evaluate task=crossing reward=sparse objects=3 episodes=200 seed=0`."""

from __future__ import annotations

from collections.abc import Mapping

from cavin_pyro.config.application import DictConfig, Figures, command, figures_table
from cavin_pyro.config.errors import UserError


def compared(found: Mapping[str, Figures]) -> str:
    """What `python -m cavin_pyro.compare` says of a sweep's runs, if they met the same scenes."""
    from cavin_pyro.evaluation.comparison import as_text, compare

    try:
        return as_text(compare(**{name: [figures["folder"]] for name, figures in found.items()}))
    except UserError:
        return figures_table(found)


@command("evaluate", compared)
def main(config: DictConfig) -> Figures:
    """Run seeded episodes and report rates with their intervals; resumes an interrupted run."""
    from pathlib import Path

    from cavin_pyro.evaluation.evaluation import evaluate

    results, folder = evaluate(config), Path(config.output)
    print(f"{(folder / 'results.txt').read_text(encoding='utf-8')}written: {folder / 'results.json'}")
    success = f"{100 * results['success']['rate']:.1f} %"
    return {"success": success, "episodes": results["episodes"], "folder": str(folder)}


if __name__ == "__main__":
    main()
