"""Collect pushing episodes: `python -m cavin_pyro.collect transitions=100000 output=DIR workers=2 seed=0`."""

from __future__ import annotations

from dataclasses import fields, replace

from cavin_pyro.config.application import DictConfig, command


@command("collect")
def main(config: DictConfig) -> None:
    """Collect pushes by the heuristic policy, or by a model, into a dataset folder, with their statistics.

    Resumes an interrupted run.
    """
    from cavin_pyro.config.commands import CollectionOptions
    from cavin_pyro.config.errors import UserError
    from cavin_pyro.data.collection import check_policy, collect, collecting_world, repair
    from cavin_pyro.data.summary import summarize_data
    from cavin_pyro.launching.launcher import chosen_launcher
    from cavin_pyro.storage.files import output_folder, write_json

    if config.minimum_objects > config.maximum_objects:
        raise UserError(f"minimum_objects must be at most maximum_objects={config.maximum_objects}")
    given = {one.name: config[one.name] for one in fields(CollectionOptions)}
    collection = replace(collecting_world(config.env), **given)
    check_policy(collection)
    with output_folder(config.output) as folder:
        launcher = chosen_launcher(config)
        if config.repair:
            print(f"{repair(collection, folder, workers=launcher)} files collected again")
        metadata = collect(collection, folder, transitions=config.transitions, workers=launcher)
        figures = summarize_data(folder)
        write_json(folder / "statistics.json", figures)
        if lost := metadata["episodes"] - figures["episodes"]:
            raise UserError(
                f"{lost} of {metadata['episodes']} episodes in {folder} are in files that are missing or corrupt: "
                "run the same command with repair=true, which collects them again"
            )
        print(f"{metadata['transitions']} transitions in {metadata['episodes']} episodes, in {folder}")


if __name__ == "__main__":
    main()
