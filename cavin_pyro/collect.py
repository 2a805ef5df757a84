"""Collect pushing episodes: `python -m cavin_pyro.collect transitions=100000 output=DIR workers=2 seed=0`."""

from __future__ import annotations

from dataclasses import replace

from omegaconf import DictConfig

from cavin_pyro.command import command


@command("collect")
def main(config: DictConfig) -> None:
    """Collect random pushes by the heuristic policy into a dataset folder, and draw what they came to.

    Resumes what was interrupted.
    """
    from cavin_pyro.collection import collect, repair
    from cavin_pyro.data_summary import summarise_data
    from cavin_pyro.errors import UserError, at_least, check_seed, fraction
    from cavin_pyro.figures_data import draw_data
    from cavin_pyro.files import output_folder, write_json
    from cavin_pyro.worlds import collecting_world
    from envs.workspace import MAXIMUM_OBJECTS

    for name in ("transitions", "workers", "steps", "hold", "minimum_objects", "episodes_per_shard"):
        at_least(name, config[name], 1)
    check_seed(config.seed)
    if not config.minimum_objects <= config.maximum_objects <= MAXIMUM_OBJECTS:
        raise UserError(
            f"maximum_objects must be between minimum_objects={config.minimum_objects} and {MAXIMUM_OBJECTS}, "
            f"not {config.maximum_objects}"
        )
    fraction("perturbed", config.perturbed)
    settings = replace(
        collecting_world(config.env),
        seed=config.seed,
        steps=config.steps,
        hold=config.hold,
        perturbed=config.perturbed,
        minimum_objects=config.minimum_objects,
        maximum_objects=config.maximum_objects,
        episodes_per_shard=config.episodes_per_shard,
    )
    folder = output_folder(config.output)
    if config.repair:
        print(f"{repair(settings, folder)} files collected again")
    metadata = collect(settings, folder, transitions=config.transitions, workers=config.workers)
    summary = summarise_data(folder)
    write_json(folder / "statistics.json", summary.figures())
    draw_data(folder / "statistics.png", summary)
    print(f"{metadata['transitions']} transitions in {metadata['episodes']} episodes, in {folder}")


if __name__ == "__main__":
    main()
