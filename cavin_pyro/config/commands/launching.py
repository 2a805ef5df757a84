"""Options of the commands whose work can go to other machines: collect and evaluate."""

from __future__ import annotations

from dataclasses import dataclass

from cavin_pyro.config.options import option


@dataclass
class LaunchOptions:
    """Where episodes are run; results do not depend on it, apart from times."""

    launcher: str = option(
        "local",
        "where episodes run: local, in processes of this machine (workers); ray, on all processors of a Ray cluster, "
        "which needs the extra .[ray]",
        choices=("local", "ray"),
        group="run",
    )
    address: str | None = option(
        None,
        "address of a running Ray cluster, host:6379; by default one on this machine is started",
        group="run",
    )
