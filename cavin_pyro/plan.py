"""Plan: `python -m cavin_pyro.plan task=crossing reward=sparse objects=3 seed=0`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, Figures, command


@command("plan")
def main(config: DictConfig) -> Figures:
    """Run one closed-loop episode from segmented depth images, and write its table, picture and video."""
    import copy

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.config.errors import user_input
    from cavin_pyro.evaluation.factory import make_runner
    from cavin_pyro.evaluation.statistics import counted, plan_summary
    from cavin_pyro.storage.files import output_folder, write_json
    from cavin_pyro.storage.provenance import provenance
    from cavin_pyro.storage.run_directory import check_same_run, write_config
    from cavin_pyro.visualization.rendering import episode_files, render_episode

    if config.viewer == "live":
        from cavin_pyro.visualization.live_page import serve

        serve(config)
        return {}
    config.device = choose_device(config.device).type
    with output_folder(config.output) as folder:
        check_same_run(folder, config, ignore=("output", "video", "video_format", "viewer", "port", "planner.compile"))
        video = config.video_format if config.video else None
        runner = make_runner(copy.deepcopy(config), render=True)
        write_config(folder, config)
        row = render_episode(runner, folder, seed=config.seed, video=video)
        write_json(folder / "results.json", {**row, "provenance": provenance()})
        with user_input("env"):
            runner.env.close()
        steps = counted(row["steps"], *runner.env.step_names)
        idle = f", {row['ineffective']} of which moved nothing" if row["ineffective"] else ""
        print(f"{runner.env.name}: {row['outcome']} after {steps}{idle}, return {row['return']:.1f}")
        if said := plan_summary([row], config):
            print(said)
        for name in episode_files(video):
            if (folder / name).exists():
                print(f"  {folder / name}")
        return {name: row[name] for name in ("outcome", "steps", "return")}


if __name__ == "__main__":
    main()
