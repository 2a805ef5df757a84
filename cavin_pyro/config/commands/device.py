"""The option `device` of the commands that run networks."""

from __future__ import annotations

from dataclasses import dataclass

from cavin_pyro.config.options import option


@dataclass
class DeviceOptions:
    """Where networks run."""

    device: str = option(
        "cpu",
        "where the networks run: the CPU, or a GPU by CUDA; auto takes the GPU where there is one. Results depend on "
        "the seed and on this: a GPU rounds differently",
        choices="cavin_pyro.config.device.DEVICES",
        group="run",
    )
