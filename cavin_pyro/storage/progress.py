"""Progress of long runs: bars with rate and remaining time, and scalars for TensorBoard."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from tqdm import tqdm


def progress_bar(label: str, *, total: int, initial: int = 0, unit: str = "step") -> tqdm[Any]:
    """A bar on the terminal; one line every half minute where the output is a file; one where nothing is left to do."""
    if 0 < total <= initial:
        print(f"{label}: finished at {unit} {total}", file=sys.stderr)
    interval = 0.2 if sys.stderr.isatty() else 30.0  # seconds
    return tqdm(
        desc=label,
        total=total,
        initial=min(initial, total),
        unit=f" {unit}s",
        mininterval=interval,
        maxinterval=max(10.0, 2 * interval),
        disable=0 < total <= initial,
    )


class ScalarLog:
    """Scalars by step in a new event file of a folder, which replaces what earlier files there show.

    Every row is on disk when `add` returns. torch's `SummaryWriter` writes in a thread: a full disk ends that in a
    traceback, and what it still holds is lost with a killed process.

    Args:
        folder: made if it is missing. rows: of an earlier run that this one resumes; each has a `step`.
    """

    def __init__(self, folder: Path, rows: Iterable[Mapping[str, float]] = ()) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}.{os.getpid()}"
        self._file = open(folder / name, "ab")  # noqa: SIM115 - closed by `__exit__`
        self._records = RecordWriter(self._file)
        self._write(Event(file_version="brain.Event:2"))
        self._write(Event(step=1, session_log=SessionLog(status=SessionLog.START)))  # shows nothing older from there on
        for row in rows:
            self.add(row)

    def __enter__(self) -> ScalarLog:
        return self

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def add(self, row: Mapping[str, float]) -> None:
        """Add the values of a row at its `step`."""
        values = [Summary.Value(tag=name, simple_value=value) for name, value in row.items()]
        self._write(Event(step=int(row["step"]), summary=Summary(value=values)))

    def _write(self, event: Event) -> None:
        event.wall_time = time.time()
        self._records.write(event.SerializeToString())
        self._records.flush()
