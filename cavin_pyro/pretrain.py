"""Pretrain PointNet: `python -m cavin_pyro.pretrain data=DIR output=DIR seed=0`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, command


@command("pretrain")
def main(config: DictConfig) -> None:
    """Train PointNet to reconstruct a dataset's clouds, and write it as a checkpoint; resumes an interrupted run."""
    import numpy as np
    import torch

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.config.parts import build_part
    from cavin_pyro.data.features import sample_clouds
    from cavin_pyro.storage.checkpoint import save
    from cavin_pyro.storage.files import output_folder, write_json
    from cavin_pyro.storage.provenance import provenance
    from cavin_pyro.storage.run_directory import check_same_run, write_config
    from cavin_pyro.training.pretraining import pretrain
    from cavin_pyro.training.run import data_folders

    device = choose_device(config.device)
    config.device = device.type
    torch.manual_seed(config.seed)
    with output_folder(config.output) as folder:
        autoencoder = build_part("autoencoder", config.autoencoder)
        clouds = sample_clouds(
            data_folders(config.data),
            count=config.clouds,
            generator=np.random.default_rng(config.seed),
            held_out_objects=config.held_out_objects,
        )
        check_same_run(folder, config, ignore=("data", "output", "device"))
        stored_config = write_config(folder, config)
        options = {name: config[name] for name in ("steps", "batch_size", "learning_rate", "seed")}
        log, resume = folder / "metrics.csv", folder / "resume.safetensors"
        losses = pretrain(autoencoder, clouds, **options, log=log, resume=resume, device=device)
        record = {**provenance(), "clouds": len(clouds), "losses": losses}
        parts = {"geometry": autoencoder.encoder, "decoder": autoencoder.decoder}
        save(folder / "pointnet.safetensors", **parts, config=stored_config, provenance=record)
        write_json(folder / "metrics.json", record)
        print(f"validation loss {losses['validation']:.4f}, against {losses['mean_shape']:.4f} for one average shape")
        print(f"written: {folder / 'pointnet.safetensors'}")


if __name__ == "__main__":
    main()
