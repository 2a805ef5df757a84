"""Train: `python -m cavin_pyro.train model=cascaded guide=cascaded data=DIR output=DIR`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from cavin_pyro.command import command

if TYPE_CHECKING:
    from cavin_pyro.training import Trainer


@command("train")
def main(config: DictConfig) -> None:
    """Train a model and its guide by stochastic variational inference; resumes what was interrupted."""
    run = train(config)
    print(f"best validation loss {run.best:.2f} at step {run.best_step}: {run.folder / 'checkpoint.safetensors'}")


def train(config: DictConfig) -> Trainer:
    """The whole of a training run, from its configuration to a folder with checkpoint, metrics and a picture.

    Returns:
        The run when it has ended.

    Raises:
        UserError: a configuration or data that cannot be used, or a loss that is not finite.
    """
    import pyro
    import torch

    from cavin_pyro.building import build_guide, build_model, build_objective, check_fit, load_pointnet
    from cavin_pyro.checkpoint import default_checkpoint, save_checkpoint
    from cavin_pyro.figures import draw_training
    from cavin_pyro.files import output_folder, write_json
    from cavin_pyro.pairs import check_pair
    from cavin_pyro.provenance import training_provenance
    from cavin_pyro.runs import check_same_data, check_same_run, write_config
    from cavin_pyro.settings import data_folders, trainer_settings, window_settings
    from cavin_pyro.training import Trainer
    from cavin_pyro.windows import load_windows
    from envs.workspace import MAXIMUM_OBJECTS

    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    trainer, window = trainer_settings(config), window_settings(config)
    torch.manual_seed(config.seed)
    model = build_model(config)
    guide = build_guide(config, model)
    objective = build_objective(config, model)
    source = Path(config.pointnet or default_checkpoint())
    pointnet = load_pointnet(source)
    check_fit(model, pointnet, MAXIMUM_OBJECTS)
    data = data_folders(config)
    windows = load_windows(data, pointnet, window, skip_corrupt=config.skip_corrupt)
    check_pair(model, guide, windows.batch(windows.training[:2]))
    print(f"{len(windows.training)} training windows, {len(windows.validation)} for validation")

    folder = output_folder(config.output)
    check_same_run(folder, config, ignore=("data", "output"))
    record = training_provenance(data, source, windows)
    check_same_data(folder, record["data"])
    settings = write_config(folder, config)
    parts = {"model": model, "guide": guide, "pointnet": pointnet}
    path = folder / "checkpoint.safetensors"

    def save(step: int, row: dict[str, float]) -> None:
        save_checkpoint(path, parts=parts, config=settings, provenance={**record, "step": step, "metrics": row})

    run = Trainer(model, guide, objective, windows, trainer, folder, save)
    run.run()
    best = next(row for row in run.rows if row["step"] == run.best_step)
    write_json(folder / "metrics.json", {**record, "steps": run.step, "best": best})
    draw_training(folder / "training.png", run.rows)
    return run


if __name__ == "__main__":
    main()
