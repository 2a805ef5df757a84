"""The library that lets the disk fail does what it says, and a trial tells what is wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config import composition
from tests.cavin_pyro.faults.commands import SUBJECTS
from tests.cavin_pyro.faults.comparison import differences, results
from tests.cavin_pyro.faults.composed import Composed
from tests.cavin_pyro.faults.plan import plans, singles
from tests.cavin_pyro.faults.report import table
from tests.cavin_pyro.faults.shim import KINDS, Call, Fault, armed, build, kinds_of, needs_faults, recorded
from tests.cavin_pyro.faults.trials import compared, ending, succeeded
from tests.cavin_pyro.shell import Answer

# Writes, a second write, fsync and rename; and a file elsewhere, which does not count.
PROGRAM = """
import os, sys
open("../elsewhere", "w").write("not counted")
with open(".a.cavin-0123abcd.partial.txt", "w") as file:
    file.write("0123456789")
    file.flush()
    file.write("abc")
    file.flush()
    os.fsync(file.fileno())
os.replace(".a.cavin-0123abcd.partial.txt", "a.txt")
descriptor = os.open("b", os.O_CREAT | os.O_WRONLY)
os.pwrite(descriptor, b"xy", 0)
os.writev(descriptor, [b"12", b"345"])
descriptor = os.open("temporary-1234", os.O_CREAT | os.O_WRONLY)
os.unlink("temporary-1234")
os.write(descriptor, b"z")
"""
PARTIAL = ".a.cavin-*.partial.txt"
CALLS = [
    *(Call("write", PARTIAL, 1), Call("write", PARTIAL, 2), Call("fsync", PARTIAL, 1), Call("rename", "a.txt", 1)),
    *(Call("write", "b", 1), Call("write", "b", 2), Call("write", "*", 1)),
]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("shim"))


def run(library: Path, folder: Path, fault: Fault | None) -> tuple[int, str, dict[str, str], list[Call], bool]:
    """Exit status, errors, files, calls, and whether the fault happened."""
    inside = folder / "inside"
    inside.mkdir()
    surroundings = {**os.environ, **armed(inside, folder / "record", fault), "LD_PRELOAD": str(library)}
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=inside, env=surroundings, capture_output=True, text=True)
    files = {path.name: path.read_text() for path in inside.iterdir()}
    return done.returncode, done.stderr, files, *recorded(folder / "record")


@needs_faults
def test_calls_within_the_folder_are_recorded_and_nothing_happens_without_a_fault(
    library: Path, tmp_path: Path
) -> None:
    status, errors, files, calls, happened = run(library, tmp_path, None)
    assert (status, errors, happened) == (0, "", False)
    assert files == {"a.txt": "0123456789abc", "b": "12345"}
    assert calls == CALLS


HALF = ".a.cavin-0123abcd.partial.txt"
EFFECTS = {  # a fault, and the files that it leaves
    "kill-before:write:{}:1": {HALF: ""},
    "torn:write:{}:1": {HALF: "01234"},
    "kill-after:write:{}:1": {HALF: "0123456789"},
    "kill-after:write:{}:2": {HALF: "0123456789abc"},
    "io-error:write:{}:2": {HALF: "0123456789abc"},  # Python writes again what it still holds when it closes the file
    "no-space:write:{}:1": {HALF: "01234"},
    "io-error:fsync:{}:1": {HALF: "0123456789abc"},
    "kill-before:rename:a.txt:1": {HALF: "0123456789abc"},
    "no-space:rename:a.txt:1": {HALF: "0123456789abc"},
    "kill-after:rename:a.txt:1": {"a.txt": "0123456789abc"},
    "torn:write:b:2": {"a.txt": "0123456789abc", "b": "12"},
    "kill-before:any:*:5": {"a.txt": "0123456789abc", "b": ""},
}


@needs_faults
@pytest.mark.parametrize("text", EFFECTS)
def test_a_fault_does_what_its_kind_says(text: str, library: Path, tmp_path: Path) -> None:
    fault = Fault.parse(text.format(PARTIAL))
    assert Fault.parse(str(fault)) == fault
    status, errors, files, _, happened = run(library, tmp_path, fault)
    assert happened
    assert files == EFFECTS[text]
    if fault.kind in ("io-error", "no-space"):
        assert status == 1
        assert {"io-error": "[Errno 5]", "no-space": "[Errno 28]"}[fault.kind] in errors
    else:
        assert (status, errors) == (-signal.SIGKILL, "")


def test_a_plan_has_every_kind_at_every_call_once_and_depends_on_its_seed_alone() -> None:
    calls = {"one": CALLS, "other": CALLS[:2]}
    count = singles(calls)
    assert count == sum(len(kinds_of(call)) for own in calls.values() for call in own) == 5 * 5 + 2 * 4 + 2 * 5
    made = plans(calls, seed=1)
    first = [next(made) for _ in range(count + 20)]
    assert len(set(first[:count])) == count and all(len(faults) == 1 for _, faults in first[:count])
    assert all(len(faults) == 2 for _, faults in first[count:])
    again = plans(calls, seed=1, first=5)
    assert [next(again) for _ in range(count)] == first[5 : 5 + count]
    other = plans(calls, seed=2)
    assert [next(other) for _ in range(count)] != first[:count]


EPISODE = '{"seed": %d, "planning_ms": [%d], "return": -1.0}\n'


def write_results(
    folder: Path, *, seeds: tuple[int, ...] = (1, 2), milliseconds: int = 3, weights: bytes = b"w"
) -> None:
    folder.mkdir()
    (folder / "episodes.jsonl").write_text("".join(EPISODE % (seed, milliseconds) for seed in seeds))
    (folder / "data.h5").write_bytes(weights)
    (folder / "results.txt").write_text(f"steps        {len(seeds)}\nplanning_ms  {milliseconds}.5  1.0 ms\n")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, []),
        ({"milliseconds": 4}, []),
        ({"weights": b"v"}, ["data.h5 differs"]),
        (
            {"seeds": (1,)},
            [
                "episodes.jsonl has lost or doubled episodes: [1], not [1, 2]",
                "episodes.jsonl differs",
                "results.txt differs",
            ],
        ),
        (
            {"seeds": (1, 2, 2)},
            [
                "episodes.jsonl has lost or doubled episodes: [1, 2, 2], not [1, 2]",
                "episodes.jsonl differs",
                "results.txt differs",
            ],
        ),
    ],
)
def test_what_differs_from_an_unbroken_run_is_said(change: dict, said: list[str], tmp_path: Path) -> None:
    write_results(tmp_path / "whole")
    write_results(tmp_path / "ours", **change)
    assert compared(tmp_path / "ours", results(tmp_path / "whole")) == said


def test_a_file_left_over_or_cut_off_is_said(tmp_path: Path) -> None:
    write_results(tmp_path / "whole")
    write_results(tmp_path / "ours")
    (tmp_path / "ours" / ".a.cavin-01234567.partial").touch()
    (tmp_path / "whole" / "b").touch()
    whole = results(tmp_path / "whole")
    assert differences(results(tmp_path / "ours"), whole) == [".a.cavin-01234567.partial is left over", "b is missing"]
    with open(tmp_path / "ours" / "episodes.jsonl", "a") as file:
        file.write('{"se')
    assert compared(tmp_path / "ours", whole)[0].startswith("the results cannot be read")


@pytest.mark.parametrize(
    ("answer", "end"),
    [
        (Answer(0, "", ""), "survived"),
        (Answer(-9, "", "training:  50%|"), "killed"),
        (Answer(2, "", "training:  50%|\nerror: the disk refused\n"), "said"),
        (Answer(2, "", "error: one\nerror: two\n"), "said badly"),
        (Answer(3, "", "error: one\n"), "said badly"),
        (Answer(1, "", "Traceback (most recent call last):\nOSError\n"), "traceback"),
        (Answer(0, "", "Exception in thread Thread-1:\nTraceback (most recent call last):\n"), "traceback"),
        (Answer(-14, "", ""), "hung for 600 s"),
    ],
)
def test_how_a_command_ended_is_named(answer: Answer, end: str) -> None:
    assert ending(answer) == end


@pytest.mark.parametrize(
    ("name", "answer", "well"),
    [
        ("merge", Answer(0, "", ""), True),
        ("merge", Answer(2, "", "error: merged holds a dataset already: choose another folder with --to DIR"), True),
        ("merge", Answer(2, "", "error: pushes holds a dataset already: choose another folder with --to DIR"), False),
        ("train", Answer(2, "", "error: run holds a dataset already"), False),
    ],
)
def test_a_finished_dataset_may_be_refused_and_nothing_else(name: str, answer: Answer, well: bool) -> None:
    assert succeeded(SUBJECTS[name], answer) is well


def test_what_a_fork_composed_is_not_composed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def compose(name: str, overrides: list[str], config_dir: str | None = None) -> DictConfig:
        asked.append((name, *overrides))
        return OmegaConf.create({"seed": 3})

    monkeypatch.setattr(composition, "check_overrides", compose)
    composed = Composed()
    composed.use()
    first = composition.check_overrides("train", ["seed=3"])
    composed.learn()
    assert composition.check_overrides("train", ["seed=3"]) == first
    assert composition.check_overrides("train", ["seed=4"]) == first
    assert asked == [("train", "seed=3")] * 2 + [("train", "seed=4")]


def test_the_report_counts_faults_by_command_and_kind() -> None:
    row = {"command": "train", "happened": ["torn:write:a:1", "io-error:any:*:2"], "ends": ["killed", "said"]}
    head, _, first, whole = table([{**row, "wrong": []}, {**row, "wrong": ["a differs"]}]).splitlines()
    assert [cell.strip() for cell in head.split("|")[2:7]] == list(KINDS)
    assert first == "| train | 0 | 0 | 2 | 0 | 2 | 4 | 2 | 2 | 0 | 1 |"
    assert whole.startswith("| **all** | 0 | 0 | 2 |")
