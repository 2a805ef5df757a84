"""Evaluate: `python -m cavin_pyro.evaluate task=crossing reward=sparse objects=3 episodes=200 seed=0`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, Figures, command


@command("evaluate")
def main(config: DictConfig) -> Figures:
    """Run seeded episodes and report rates with their intervals; resumes an interrupted run."""
    from pathlib import Path

    from cavin_pyro.evaluation.evaluation import evaluate

    results, folder = evaluate(config), Path(config.output)
    print(f"{(folder / 'results.txt').read_text(encoding='utf-8')}written: {folder / 'results.json'}")
    return {"success": f"{100 * results['success']['rate']:.1f} %", "episodes": results["episodes"]}


if __name__ == "__main__":
    main()
