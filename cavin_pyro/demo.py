"""The main job, once per task: `python -m cavin_pyro.demo`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, command


@command("demo")
def main(config: DictConfig) -> None:
    """Plan and execute an episode of each task with `checkpoint=contact`, from segmented depth images."""
    import copy

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.evaluation.factory import make_runner
    from cavin_pyro.evaluation.statistics import counted
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import write_config
    from cavin_pyro.visualization.rendering import render_episode

    config.device = choose_device(config.device).type
    with output_folder(config.output):
        for task in config.tasks:
            options = copy.deepcopy(config)
            options.task, options.tiles = task, {}
            runner = make_runner(copy.deepcopy(options), render=True)
            with output_folder(f"{config.output}/{task}") as folder:
                write_config(folder, options)
                row = render_episode(runner, folder, seed=config.seed, video=True)
            runner.env.close()
            print(f"{task}: {row['outcome']} after {counted(row['steps'], 'push', 'pushes')}")
            for what, name in (("picture", "plan.png"), ("from above", "plan-above.png"), ("video", "episode.mp4")):
                print(f"  {what:<11}{folder / name}", flush=True)


if __name__ == "__main__":
    main()
