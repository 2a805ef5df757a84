"""Calibrate a guide: `python -m cavin_pyro.calibrate checkpoint=FILE data=DIR output=DIR`."""

from __future__ import annotations

from typing import Any

from cavin_pyro.config.application import DictConfig, command


@command("calibrate")
def main(config: DictConfig) -> None:
    """Calibrate a trained guide, or the scales that f predicts, so that intervals have their nominal coverage.

    The guide is fitted to windows that its model generates, the scales to held-out windows.
    """
    import pyro

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.criticism import recalibration
    from cavin_pyro.criticism.guide import assess_guide
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    device = choose_device(config.device)
    config.device = device.type
    with output_folder(config.output) as folder:
        check_same_run(folder, config, ignore=("output", "device"))
        loaded, context = recalibration.load_calibration(config)
        write_config(folder, config)
        measured: dict[str, Any] = {}
        sizes = {"windows": config.windows, "samples": config.samples}
        if "scales" in config.parts:
            factor, before, after = recalibration.calibrate_f(context, **sizes)
            measured["scales"] = {"factor": factor, "before": before.values, "after": after.values}
            print(f"f's scales of centres are {factor:.3g} times what they were")
            recalibration.print_change(before, after)
        if "guide" in config.parts:
            before = assess_guide(context, **sizes)
            recalibration.calibrate_guide(config, loaded, device)
            after = assess_guide(context, **sizes)
            measured |= {"before": before.values, "after": after.values}
            recalibration.print_change(before, after)
        print(f"written: {recalibration.write_calibrated(folder, config, loaded, measured)}")


if __name__ == "__main__":
    main()
