"""Pretrain PointNet: `python -m cavin_pyro.pretrain data=DIR output=DIR seed=0`."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.command import command


@command("pretrain")
def main(config: DictConfig) -> None:
    """Train PointNet to draw a dataset's clouds again, and write it as a checkpoint."""
    import numpy as np
    import torch

    from cavin_pyro.building import check_sizes, construct
    from cavin_pyro.checkpoint import save_checkpoint
    from cavin_pyro.errors import UserError, at_least, check_seed
    from cavin_pyro.features import sample_clouds
    from cavin_pyro.figures import draw_reconstructions
    from cavin_pyro.files import output_folder, write_json
    from cavin_pyro.pretraining import pretrain
    from cavin_pyro.provenance import provenance
    from cavin_pyro.runs import write_config
    from cavin_pyro.settings import data_folders

    for name, minimum in (("clouds", 2), ("steps", 1), ("batch_size", 1)):
        at_least(name, config[name], minimum)
    if not config.learning_rate > 0:
        raise UserError(f"learning_rate must be a positive number, not {config.learning_rate}")
    check_seed(config.seed)
    check_sizes("autoencoder", config.autoencoder)
    torch.manual_seed(config.seed)
    autoencoder = construct(config.autoencoder)
    clouds = sample_clouds(
        data_folders(config),
        count=config.clouds,
        generator=np.random.default_rng(config.seed),
        without=config.without,
    )
    folder = output_folder(config.output)
    settings = write_config(folder, config)
    losses = pretrain(
        autoencoder,
        clouds,
        steps=config.steps,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        seed=config.seed,
        log=folder / "metrics.csv",
    )
    record = {**provenance(), "clouds": len(clouds), "losses": losses}
    parts = {"pointnet": autoencoder.encoder, "decoder": autoencoder.decoder}
    save_checkpoint(folder / "pointnet.safetensors", parts=parts, config=settings, provenance=record)
    write_json(folder / "metrics.json", record)
    draw_reconstructions(folder / "reconstructions.png", autoencoder, clouds[:8])
    print(f"validation loss {losses['validation']:.4f}, against {losses['mean_shape']:.4f} for one average shape")
    print(f"written: {folder / 'pointnet.safetensors'}")


if __name__ == "__main__":
    main()
