"""Where a command's jobs run: the options `launcher`, `address` and `workers`."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.launching.cluster import in_cluster
from cavin_pyro.launching.workers import in_workers

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Launcher:
    """`local`: processes of this machine, `workers` of them. `ray`: the processors of the cluster at `address`."""

    name: str = "local"
    workers: int = 2
    address: str | None = None

    @property
    def here(self) -> bool:
        """Whether jobs need no other process than this one."""
        return self.name == "local" and self.workers == 1

    def run(
        self, function: Callable[[Job], Result], jobs: Iterable[Job], *, ordered: bool = False
    ) -> Generator[tuple[int, Result], None, None]:
        """Yield the number of each job and what the function makes of it; see `in_workers` and `in_cluster`."""
        if self.name == "ray":
            return in_cluster(function, jobs, self.address, ordered=ordered)
        return in_workers(function, jobs, self.workers, ordered=ordered)


def chosen_launcher(config: DictConfig) -> Launcher:
    """The launcher that the options `launcher`, `workers` and `address` name.

    Raises:
        UserError: an address that nothing would read.
    """
    if config.address is not None and config.launcher != "ray":
        raise UserError(f"address={config.address} is of launcher=ray: add that, or leave address")
    return Launcher(config.launcher, config.workers, config.address)


def as_launcher(workers: int | Launcher) -> Launcher:
    """A number of processes of this machine as a launcher."""
    return workers if isinstance(workers, Launcher) else Launcher(workers=workers)


def of_shard(items: Sequence[Job], shard: str) -> Sequence[Job]:
    """Those of `i/n`: the i-th, counted from 1, and every n-th after it.

    Raises:
        UserError: it is not of that form.
    """
    number, _, count = shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise UserError(f"shard must be i/n with 1 <= i <= n, such as 2/3, not {shard}")
    return items[int(number) - 1 :: int(count)]
