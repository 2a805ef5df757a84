"""Reproduce the paper's figure: `python -m cavin_pyro.reproduce scale=smoke`."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.config.application import command


@command("reproduce")
def main(config: DictConfig) -> None:
    """Run the paper's experiments from scratch: collect, pretrain, train four methods, evaluate every cell, draw.

    Resumes an interrupted run, and skips finished work.
    """
    from pathlib import Path

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.reproduction.episodes.picture import draw_chosen_episodes
    from cavin_pyro.reproduction.merging import IGNORED, check_shards, merge_tables
    from cavin_pyro.reproduction.methods import chosen_methods
    from cavin_pyro.reproduction.pipeline import as_typed, check_inputs, chosen_rows, run_pipeline
    from cavin_pyro.reproduction.results import write_results
    from cavin_pyro.reproduction.table import read_table
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.provenance import PROVENANCE, append_provenance
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    device = choose_device(config.device).type  # `auto` chooses once, for all stages
    typed = as_typed(config)
    config.methods = list(chosen_methods(config))
    with output_folder(config.output) as home:
        check_same_run(home, config, ignore=IGNORED)
        rows = chosen_rows(read_table(Path(config.table)), config) if config.table else []
        if config.merge:
            check_shards([Path(folder) for folder in config.merge])
        elif not config.table:
            check_inputs(config)
        write_config(home, config)
        append_provenance(home / PROVENANCE, Path(config.extends).with_name(PROVENANCE) if config.extends else None)
        if config.merge:
            rows = merge_tables(config, home, [Path(folder) for folder in config.merge])
        elif not config.table:
            rows = run_pipeline(config, home, device)
        for path in write_results(home, rows, typed):
            print(path)
        if config.pictures is not None:
            folders = [Path(folder) for folder in config.merge] or [home]
            for path in draw_chosen_episodes(home, folders, rows, config.pictures):
                print(path)


if __name__ == "__main__":
    main()
