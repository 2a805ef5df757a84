"""From nothing to a planner of one's own: `python -m cavin_pyro.quickstart minutes=20`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, command


@command("quickstart")
def main(config: DictConfig) -> None:
    """Collect, train, evaluate and draw an episode: an experiment of some minutes on two idle cores.

    It says each command that it runs, so that parts can be changed and run again. Resumes an interrupted run.
    """
    import shlex
    import sys
    import time
    from importlib import import_module

    import torch

    from cavin_pyro.config.recipes import steps_of
    from cavin_pyro.config.world import world_of
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    if (world := world_of(config)) is not None:  # what is none is refused before anything is written
        world.close()
    with output_folder(config.output) as home:
        check_same_run(home, config, ignore=("output", "workers", "episodes"))
        write_config(home, config)
        steps, begun = list(steps_of(config, home)), time.monotonic()
        for number, step in enumerate(steps):
            left = max(1, round(sum(one.minutes for one in steps[number:])))
            threads, variable = (2, "OMP_NUM_THREADS=2 ") if step.command == "train" else (1, "")
            torch.set_num_threads(threads)
            line = f"{variable}python -m cavin_pyro.{step.command} {shlex.join(step.options)}"
            print(f"\n{number + 1} of {len(steps)}, about {left} min to go: {line}", flush=True)
            sys.argv = [f"cavin_pyro/{step.command}.py", *step.options, *({"--traceback"} & {*sys.argv})]
            import_module(f"cavin_pyro.{step.command}").main()
        print(f"\n{(time.monotonic() - begun) / 60:.1f} min in all, in {home}")


if __name__ == "__main__":
    main()
