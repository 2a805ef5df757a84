"""Options of where and how a command runs: the device of networks, processes, other machines."""

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
    )


@dataclass
class LaunchOptions:
    """Where episodes are run; results do not depend on it, apart from times."""

    workers: int = option(2, "processes; results do not depend on it, apart from times", minimum=1, maximum=1024)
    launcher: str = option(
        "local",
        "where episodes run: local, in processes of this machine (workers); ray, on all processors of a Ray cluster, "
        "which needs the extra .[ray]",
        choices=("local", "ray"),
    )
    address: str | None = option(
        None, "address of a running Ray cluster, host:6379; by default one on this machine is started"
    )
