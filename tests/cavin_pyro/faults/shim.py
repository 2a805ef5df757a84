"""Which call of a command goes wrong and how, and the shared library that makes it so (shim.c)."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

SOURCE = Path(__file__).with_name("shim.c")
COMPILER = os.environ.get("CC", "cc")
KINDS = ("kill-before", "kill-after", "torn", "no-space", "io-error")
KILLS = ("kill-before", "kill-after", "torn")
LIMIT = 600  # seconds for a command: more is a hang; the machine may be busy with other work

needs_faults = pytest.mark.skipif(
    not sys.platform.startswith("linux") or shutil.which(COMPILER) is None,
    reason="faults of the disk need Linux and a C compiler: cc, or one that CC names",
)


@dataclass(frozen=True)
class Call:
    """The `count`-th call of an operation on a file. operation: write, fsync, rename, or `any`, for any file."""

    operation: str
    name: str
    count: int


@dataclass(frozen=True)
class Fault:
    """A call and one of `KINDS`."""

    call: Call
    kind: str

    def __str__(self) -> str:
        return ":".join((self.kind, self.call.operation, self.call.name, str(self.call.count)))

    @staticmethod
    def parse(text: str) -> Fault:
        """The fault that `str` gave."""
        kind, operation, name, count = text.split(":")
        if kind not in KINDS:
            raise ValueError(f"unknown kind {kind!r}: choose from {', '.join(KINDS)}")
        return Fault(Call(operation, name, int(count)), kind)


def kinds_of(call: Call) -> tuple[str, ...]:
    """What can happen to a call: only a write can be torn."""
    return tuple(kind for kind in KINDS if kind != "torn" or call.operation == "write")


def build(folder: Path) -> Path:
    """Compile the library into a folder, unless it is there."""
    library = folder / "shim.so"
    if not library.exists():
        line = [COMPILER, "-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror", "-o", str(library), str(SOURCE)]
        subprocess.run(line, check=True, capture_output=True, text=True)
    return library


def armed(folder: Path, record: Path, fault: Fault | None) -> dict[str, str]:
    """The environment of a process in which a fault happens, or none, but calls beneath `folder` are recorded."""
    call = fault.call if fault else Call("", "", 0)
    return {
        "FAULT_FOLDER": str(folder.resolve()),
        "FAULT_RECORD": str(record),
        "FAULT_KIND": fault.kind if fault else "none",
        "FAULT_OPERATION": call.operation,
        "FAULT_NAME": call.name,
        "FAULT_COUNT": str(call.count),
    }


def recorded(record: Path) -> tuple[list[Call], bool]:
    """The calls that a process made, and whether the fault happened."""
    lines = record.read_text().splitlines() if record.exists() else []
    counts: dict[tuple[str, str], int] = {}
    calls, happened = [], False
    for line in lines:
        operation, name, kind = line.split("\t")
        counts[operation, name] = counts.get((operation, name), 0) + 1
        calls.append(Call(operation, name, counts[operation, name]))
        happened |= bool(kind)
    return calls, happened
