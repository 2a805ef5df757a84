"""Reproduce the paper's figure: `python -m cavin_pyro.reproduce scale=smoke`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, command


@command("reproduce")
def main(config: DictConfig) -> None:
    """Run the paper's experiments from scratch: collect, pretrain, train four methods, evaluate every cell, draw.

    Resumes an interrupted run, and skips finished work.
    """
    from pathlib import Path

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.reproduction.pipeline import check_inputs, run_pipeline
    from cavin_pyro.reproduction.results import write_results
    from cavin_pyro.reproduction.table import chosen_rows, read_table
    from cavin_pyro.storage.files import output_folder, write_json
    from cavin_pyro.storage.provenance import provenance
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    # Options that may change when a run goes on.
    extended = ("planners", "tasks", "objects", "rewards", "episodes", "bottom_episodes", "shard", "workers", "output")
    device = choose_device(config.device).type  # `auto` chooses once, for all stages
    with output_folder(config.output) as home:
        check_same_run(home, config, ignore=extended)
        if config.table:
            table = chosen_rows(read_table(Path(config.table)), config)
        else:
            check_inputs(config)
        write_config(home, config)
        record = provenance()
        write_json(home / "provenance.json", record)
        if not config.table:
            table = run_pipeline(config, home, device)
        for path in write_results(home, table, record["command"]):
            print(path)


if __name__ == "__main__":
    main()
