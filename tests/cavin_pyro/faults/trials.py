"""One trial: a command meets faults, one run after the other, then none; what it has made in the end is compared."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.cavin_pyro.faults.commands import DATA, SUBJECTS, Commands, Subject, prepare
from tests.cavin_pyro.faults.comparison import differences, results, seeds
from tests.cavin_pyro.faults.shim import KILLS, LIMIT, Call, Fault, recorded
from tests.cavin_pyro.shell import Answer

REPLAY = "python -m tests.cavin_pyro.faults --replay"


@dataclass
class Outcome:
    """How a trial went.

    Attributes:
        happened: the faults that came about, as text. ends: of their runs: killed, said (in one line) or survived (it
            did no harm). wrong: what should not be, a line each.
    """

    happened: list[str] = field(default_factory=list)
    ends: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


class Trials:
    """Unbroken runs of the subjects, made as they are needed, and trials to compare with them.

    Args:
        home: an empty folder.
    """

    def __init__(self, home: Path) -> None:
        self.home, self.commands = home, Commands(home)
        self.calls: dict[str, list[Call]] = {}
        self._whole: dict[str, dict[str, Any]] = {}
        self._number = 0

    def close(self) -> None:
        self.commands.close()

    def unbroken(self, name: str) -> dict[str, Any]:
        """What a subject's folder holds after a run that met no fault."""
        subject = SUBJECTS[name]
        record = self.home / f"{subject.output}.calls"  # the same for all stages of a command
        if subject.output not in self._whole:
            for needed in subject.inputs:
                self._make(needed)
            folder = self.home / "unbroken" / name
            self._run_whole(subject, prepare(folder, subject, self.home / "made", whole=True), record)
            self._whole[subject.output] = results(folder)
            shutil.copytree(folder / subject.output, self.home / "made" / subject.output)
            shutil.rmtree(folder)
        if name not in self.calls:
            self.calls[name] = [call for call in recorded(record)[0] if subject.meets(call)]
        return self._whole[subject.output]

    def _make(self, output: str) -> None:
        """What other subjects need."""
        if (self.home / "made" / output).exists():
            return
        if output not in DATA:
            self.unbroken(next(name for name, subject in SUBJECTS.items() if subject.output == output))
            return
        folder = self.home / "made"
        folder.mkdir(exist_ok=True)
        for subject in DATA[output]:
            for needed in subject.inputs:
                self._make(needed)
            self._run_whole(subject, folder, self.home / "data.calls")

    def _run_whole(self, subject: Subject, folder: Path, record: Path) -> None:
        answer = self.commands.run(subject, folder, None, record)
        if answer.status or answer.complaints:
            raise RuntimeError(f"{subject.command} fails without a fault: {answer.status}, {answer.errors}")

    def run(self, name: str, faults: Sequence[Fault]) -> Outcome:
        """Let a command meet faults, then run it again without one."""
        whole, subject, outcome = self.unbroken(name), SUBJECTS[name], Outcome()
        self._number += 1
        home = self.home / f"trial-{self._number}"
        folder = prepare(home / "folder", subject, self.home / "made")
        try:
            for number, fault in enumerate(faults):
                end = self._meet(subject, folder, fault, home / f"record-{number}", outcome.wrong)
                if end is not None:
                    outcome.happened.append(str(fault))
                    outcome.ends.append(end)
            _age(folder)
            answer = self.commands.run(subject, folder, None, home / "record")
            if not succeeded(subject, answer):
                outcome.wrong.append(f"the run after it ended with {answer.status}: {' / '.join(answer.complaints)}")
            else:
                outcome.wrong += compared(folder, whole)
        finally:
            shutil.rmtree(home)
        return outcome

    def _meet(self, subject: Subject, folder: Path, fault: Fault, record: Path, wrong: list[str]) -> str | None:
        """Run with one fault; returns how it ended, or None where the fault did not happen."""
        answer = self.commands.run(subject, folder, fault, record)
        _, happened = recorded(record)
        if not happened:
            if not succeeded(subject, answer):
                wrong.append(f"without {fault} the run ended with {answer.status}: {' / '.join(answer.complaints)}")
            return None
        end = ending(answer)
        if end not in expected_ends(subject, fault):
            last = answer.errors.strip().splitlines()[-6:]
            wrong.append(f"{fault} ended with {answer.status} ({end}): {' / '.join(last)}")
        return end


def _age(folder: Path) -> None:
    """Let hours pass: what was left half-written among features may be of another training, as long as it is young."""
    for path in folder.glob("*/features-*/.*"):
        os.utime(path, (0, 0))


def ending(answer: Answer) -> str:
    """killed, said, survived, hung, traceback, or what else happened."""
    if "Traceback" in answer.errors or "Exception ignored" in answer.errors:
        return "traceback"
    if answer.status == -signal.SIGALRM:
        return f"hung for {LIMIT} s"
    if answer.status == -signal.SIGKILL:
        return "killed"
    if answer.status == 0:
        return "survived"
    one_line = len(answer.complaints) == 1 and answer.complaints[0].startswith("error: ")
    return "said" if answer.status in (1, 2) and one_line else "said badly"


def succeeded(subject: Subject, answer: Answer) -> bool:
    """Whether a run without a fault did its work, or had nothing left to do."""
    if subject.once and answer.status == 2 and len(answer.complaints) == 1:
        return f"{subject.output} holds a dataset already" in answer.complaints[0]
    return not answer.status and not answer.complaints


def expected_ends(subject: Subject, fault: Fault) -> tuple[str, ...]:
    """How a run may end. A killed stage of `reproduce`, ffmpeg or worker is told by the command that started it."""
    if fault.kind not in KILLS:
        return ("said", "survived")
    by_others = fault.call.name.endswith(".mp4") or "/.data.partial/" in fault.call.name  # ffmpeg, export's worker
    return ("killed", "said", "survived") if by_others or subject.command == "reproduce" else ("killed",)


def compared(folder: Path, whole: dict[str, Any]) -> list[str]:
    """What a folder holds otherwise than that of an unbroken run; lost and doubled episodes first."""
    try:
        ours = results(folder)
    except (ValueError, KeyError, IndexError) as error:
        return [f"the results cannot be read: {error}"]
    said = []
    for name, content in whole.items():
        wanted, have = seeds(content), seeds(ours.get(name))
        if wanted is not None and sorted(have or []) != sorted(wanted):
            said.append(f"{name} has lost or doubled episodes: {have}, not {wanted}")
    return said + differences(ours, whole)
