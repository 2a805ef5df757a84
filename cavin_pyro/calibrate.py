"""Calibrate a guide: `python -m cavin_pyro.calibrate checkpoint=FILE data=DIR output=DIR`."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.config.application import command


@command("calibrate")
def main(config: DictConfig) -> None:
    """Fit a trained guide to windows that its model generates, so that its intervals have their nominal coverage."""
    import pyro

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.criticism.recalibration.measurement import measure_guide, sentences
    from cavin_pyro.criticism.recalibration.run import calibrate_guide, load_calibration, write_calibrated
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    device = choose_device(config.device)
    config.device = device.type
    with output_folder(config.output) as folder:
        check_same_run(folder, config, ignore=("output", "device"))
        loaded, context = load_calibration(config)
        write_config(folder, config)
        sizes = {name: config[name] for name in ("windows", "samples", "repeats")}
        before = measure_guide(context, **sizes)
        losses = calibrate_guide(config, loaded, device)
        after = measure_guide(context, **sizes)
        print("\n".join(sentences(before, after)))
        path = write_calibrated(folder, config, loaded, before=before, after=after, losses=losses)
        print(f"written: {path}")


if __name__ == "__main__":
    main()
