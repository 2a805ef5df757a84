"""Evaluate: `python -m cavin_pyro.evaluate task=crossing reward=sparse objects=3 episodes=200 seed=0`."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.command import command


@command("evaluate")
def main(config: DictConfig) -> None:
    """Run seeded episodes and report rates with their intervals; resumes what was interrupted."""
    import copy
    from pathlib import Path

    from cavin_pyro.comparison import compare, earlier_rows, record, sentences
    from cavin_pyro.errors import at_least
    from cavin_pyro.evaluation import evaluate
    from cavin_pyro.files import output_folder, replacing, write_json
    from cavin_pyro.provenance import provenance
    from cavin_pyro.runs import check_same_run, write_config
    from cavin_pyro.setups import set_up
    from cavin_pyro.statistics import summarise, table

    at_least("episodes", config.episodes, 1)
    at_least("workers", config.workers, 1)
    set_up(copy.deepcopy(config)).env.close()  # bad input is told before anything is written
    others = earlier_rows(Path(config.compare), config) if config.compare else []
    folder = output_folder(config.output)
    check_same_run(folder, config, ignore=("output", "episodes", "workers", "compare"))
    write_config(folder, config)
    results = summarise(evaluate(config, folder))
    text = table(results, f"{config.task}, layout {config.layout}, {config.reward} reward, {config.objects} objects")
    if others:
        comparison = compare(results["per_episode"], others)
        results["comparison"] = record(comparison, Path(config.compare))
        text += "\n" + sentences(comparison, Path(config.compare))
    write_json(folder / "results.json", {**results, "provenance": provenance()})
    with replacing(folder / "results.txt") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    print(f"{text}\nwritten: {folder / 'results.json'}")


if __name__ == "__main__":
    main()
