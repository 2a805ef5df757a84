"""Plan: `python -m cavin_pyro.plan task=crossing reward=sparse objects=3 seed=0`."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.command import command


@command("plan")
def main(config: DictConfig) -> None:
    """Run one closed-loop episode from depth images and leave a folder with its table, picture and video."""
    import copy
    from pathlib import Path

    from cavin_pyro.files import output_folder, write_json
    from cavin_pyro.provenance import provenance
    from cavin_pyro.runs import check_same_run, write_config
    from cavin_pyro.setups import set_up, tell_of_compiling
    from cavin_pyro.showing import episode_files, show_episode
    from cavin_pyro.viewers import check_viewer

    check_viewer(config.viewer)
    check_same_run(Path(config.output), config, ignore=("output", "video", "viewer"))
    setup = set_up(copy.deepcopy(config), render=True)
    folder = output_folder(config.output)
    write_config(folder, config)
    tell_of_compiling(config)
    row = show_episode(setup, folder, seed=config.seed, video=config.video, viewer=config.viewer)
    setup.env.close()
    write_json(folder / "results.json", {**row, "provenance": provenance()})
    print(f"{config.task}: {row['outcome']} after {row['steps']} pushes, return {row['return']:.1f}")
    for name in episode_files(video=config.video, viewer=config.viewer):
        print(f"  {folder / name}")


if __name__ == "__main__":
    main()
