"""Imagine: `python -m cavin_pyro.imagine checkpoint=contact task=crossing seed=1`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, Figures, command


@command("imagine")
def main(config: DictConfig) -> Figures:
    """Sample effects and motions of one scene, carry the motions out in physics, and draw what the codes mean."""
    import copy

    from cavin_pyro.config.errors import user_input
    from cavin_pyro.criticism.imagination import draw_imagination
    from cavin_pyro.evaluation.factory import check_space, make_env
    from cavin_pyro.storage.checkpoint import load
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    with output_folder(config.output) as folder:
        check_same_run(folder, config, ignore=("output",))
        with user_input("checkpoint", "task", "tiles", "env", "layout", "generated"):
            trained = load(config.checkpoint, trust=list(config.trust))
            world = make_env(copy.deepcopy(config), geometry=trained.geometry, render=True)
            check_space(trained, world)
        write_config(folder, config)
        sizes = {name: config[name] for name in ("seed", "effects", "motions")}
        table = draw_imagination(folder / "imagine.png", trained.model, world, **sizes)
        world.close()
        table.to_csv(folder / "imagine.csv")
        print(table.to_string(float_format="{:.2f}".format))
        print(f"  {folder / 'imagine.csv'}\n  {folder / 'imagine.png'}")
        return {"error": float(table.to_numpy().mean())}


if __name__ == "__main__":
    main()
