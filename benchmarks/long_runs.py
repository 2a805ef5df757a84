"""Do long runs stay flat? `python benchmarks/long_runs.py --turns 100000 --log runs/long.jsonl`; resumes.

A turn is a reset, a plan and a push; every tenth also opens and closes another environment. Measured after every
stretch of turns: memory, open files, simulations (PyBullet's clients) and the CPU time of a turn. A quantity rises if
the 95 % interval of its slope (Theil and Sen's; a process's first quarter left out, for caches) lies above a limit.
Exit status 1 if one rises. `--leak` makes it rise on purpose.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import theilslopes
from tqdm import tqdm

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.factory import make_environment, make_runner
from envs.physics.bullet import connect, pybullet

SMALL = ("task=crossing", "objects=2", "planner.samples=32", "planner.horizon=3", "maximum_steps=1", "output=-")
CLIENTS = 1024  # the most that PyBullet can have
QUANTITIES = ("memory_mb", "files", "clients", "turn_ms")


@dataclass(frozen=True)
class Measurement:
    """A stretch of turns that ends at `turn`. turn_ms: of CPU, the median over its turns."""

    turn: int
    memory_mb: float
    files: float
    clients: float
    turn_ms: float


@dataclass(frozen=True)
class Slope:
    """How a quantity changes in 1,000 turns, with its 95 % interval, and the limit that the interval may not exceed."""

    name: str
    median: float
    value: float
    low: float
    high: float
    limit: float

    @property
    def rises(self) -> bool:
        return self.low > self.limit

    def __str__(self) -> str:
        verdict = "RISES" if self.rises else "flat"
        interval = f"{self.value:+.3f} ({self.low:+.3f} to {self.high:+.3f})"
        return f"| {self.name} | {self.median:.2f} | {interval} | {self.limit:.3f} | {verdict} |"


def slopes(measured: Sequence[Measurement], *, memory_limit: float = 1.0, time_limit: float = 0.1) -> list[Slope]:
    """The slope of every quantity.

    Args:
        memory_limit: MB in 1,000 turns. time_limit: share of the median by which a time may grow over the whole run.
    """
    late = measured[len(measured) // 4 :]
    turns = np.array([one.turn for one in late]) / 1000.0
    found = []
    for name in QUANTITIES:
        values = np.array([getattr(one, name) for one in late])
        value, _, low, high = theilslopes(values, turns, alpha=0.95)
        limit = {"memory_mb": memory_limit, "files": 0.0, "clients": 0.0}.get(name)
        if limit is None:
            limit = time_limit * float(np.median(values)) / (turns[-1] - turns[0])
        found.append(Slope(name, float(np.median(values)), float(value), float(low), float(high), limit))
    return found


def measure(turns: int, every: int, *, leak: Sequence[str] = (), first: int = 0) -> Iterator[Measurement]:
    """Yield a measurement after every so many turns.

    Args:
        leak: of `QUANTITIES`, what is to rise on purpose. first: turns of an earlier process, whose scenes come first.
    """
    config = compose("evaluate", *SMALL)
    runner = make_runner(config)
    kept: list[object] = []
    spent: list[float] = []
    for turn in range(first + 1, first + turns + 1):
        began = time.process_time()
        runner.rollout(turn)
        while "turn_ms" in leak and time.process_time() - began < turn / 100:
            pass
        spent.append(time.process_time() - began)
        if turn % 10 == 0:
            make_environment(config).close()
        kept += _leak(leak)
        if turn % every == 0:
            yield Measurement(turn, *_held(), 1e3 * float(np.median(spent)))
            spent.clear()
    runner.env.close()


def _leak(names: Sequence[str]) -> list[object]:
    """What a leak of each kind holds after a turn."""
    held: list[object] = []
    if "memory_mb" in names:
        held.append(np.ones(2**20))  # 8 MB
    if "files" in names:
        held.append(os.open(os.devnull, os.O_RDONLY))
    if "clients" in names:
        held.append(connect())
    return held


def _held() -> tuple[float, float, float]:
    """Megabytes in memory, open files and connected simulations of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    clients = sum(bool(pybullet.isConnected(number)) for number in range(CLIENTS))
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, float(len(os.listdir("/proc/self/fd"))), float(clients)


def report(found: Sequence[Slope], turns: int) -> str:
    """The slopes as a Markdown table."""
    head = "| quantity | median | in 1,000 turns (95 %) | limit | |\n| --- | ---: | ---: | ---: | --- |"
    return "\n".join([f"{turns:,} turns", "", head, *map(str, found)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=100_000, help="in all, with those in the log")
    parser.add_argument("--every", type=int, default=100, help="turns between measurements")
    parser.add_argument("--memory-limit", type=float, default=1.0, help="MB in 1,000 turns")
    parser.add_argument("--time-limit", type=float, default=0.1, help="share of a turn's time, over the whole run")
    parser.add_argument("--leak", nargs="+", choices=QUANTITIES, default=[], help="what is to rise on purpose")
    parser.add_argument("--log", type=Path, help="measurements as JSON, a line each: a second run goes on after them")
    arguments = parser.parse_args()
    lines = arguments.log.read_text().splitlines() if arguments.log and arguments.log.exists() else []
    first = max((json.loads(line)["turn"] for line in lines if line.endswith("}")), default=0)
    measured = []
    if arguments.log:
        arguments.log.parent.mkdir(parents=True, exist_ok=True)
    with open(arguments.log or os.devnull, "a", encoding="utf-8") as log:
        for one in tqdm(
            measure(arguments.turns - first, arguments.every, leak=arguments.leak, first=first),
            total=(arguments.turns - first) // arguments.every,
        ):
            measured.append(one)
            print(json.dumps(asdict(one)), file=log, flush=True)
    if len(measured) < 4:
        print(f"{len(measured)} measurements: too few for slopes; give more --turns")
        return 0
    found = slopes(measured, memory_limit=arguments.memory_limit, time_limit=arguments.time_limit)
    print(report(found, measured[-1].turn - first))
    return int(any(one.rises for one in found))


if __name__ == "__main__":
    raise SystemExit(main())
