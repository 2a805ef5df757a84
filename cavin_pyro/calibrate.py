"""Calibrate a guide: `python -m cavin_pyro.calibrate checkpoint=FILE data=DIR output=DIR`."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from cavin_pyro.config.application import command


@command("calibrate")
def main(config: DictConfig) -> None:
    """Calibrate a trained guide, or the scales that f predicts, so that intervals have their nominal coverage.

    The guide is fitted to windows that its model generates, the scales to held-out windows.
    """
    import pyro

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.criticism.recalibration.measurement import measure_guide, sentences
    from cavin_pyro.criticism.recalibration.run import (
        calibrate_f,
        calibrate_guide,
        load_calibration,
        write_calibrated,
    )
    from cavin_pyro.criticism.recalibration.scales import scale_sentences
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    device = choose_device(config.device)
    config.device = device.type
    with output_folder(config.output) as folder:
        check_same_run(folder, config, ignore=("output", "device"))
        loaded, context = load_calibration(config)
        write_config(folder, config)
        measured: dict[str, Any] = {}
        if "scales" in config.parts:
            measured["scales"] = found = calibrate_f(context, config.windows)
            print("\n".join(scale_sentences(found["before"], found["after"], found["factor"])))
        if "guide" in config.parts:
            sizes = {name: config[name] for name in ("windows", "samples", "repeats")}
            before = measure_guide(context, **sizes)
            losses = calibrate_guide(config, loaded, device)
            after = measure_guide(context, **sizes)
            measured |= {"before": before, "after": after, "losses": losses}
            print("\n".join(sentences(before, after)))
        print(f"written: {write_calibrated(folder, config, loaded, measured)}")


if __name__ == "__main__":
    main()
