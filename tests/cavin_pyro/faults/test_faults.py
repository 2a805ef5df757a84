"""Every command meets a few faults of the disk, and resumes to the results of an unbroken run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cavin_pyro.faults.commands import SUBJECTS
from tests.cavin_pyro.faults.plan import Plan, plans
from tests.cavin_pyro.faults.shim import needs_faults
from tests.cavin_pyro.faults.trials import REPLAY, Trials

SEED = 24
SHORT = ("collect", "pretrain", "evaluate")  # in `make test`; `make soak` tries all commands


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trials]:
    """Trials, with the runs to compare with made as they are needed."""
    folder = Path(tmp_path_factory.mktemp("faults", numbered=True))
    made = Trials(folder)
    yield made
    made.close()


def chosen(trials: Trials, name: str) -> list[Plan]:
    """The first faults of a command by the fixed seed."""
    trials.unbroken(name)
    several = plans({name: trials.calls[name]}, SEED)
    return [next(several) for _ in range(3 if name in SHORT else 1)]


@needs_faults
@pytest.mark.parametrize(
    "name", [name if name in SHORT else pytest.param(name, marks=pytest.mark.soak) for name in SUBJECTS]
)
def test_a_command_that_met_a_fault_resumes_to_the_results_of_an_unbroken_run(name: str, trials: Trials) -> None:
    wrong = {}
    for _, faults in chosen(trials, name):
        outcome = trials.run(name, faults)
        assert outcome.ends, f"{faults} did not happen"
        if outcome.wrong:
            wrong[f"{REPLAY} {name} {' '.join(map(str, faults))}"] = outcome.wrong
    assert not wrong
