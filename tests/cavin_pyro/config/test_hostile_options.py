"""Options that ask for more than there is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cavin_pyro.config.application import guarded
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import check_value, options


@pytest.mark.parametrize(
    "ask", [lambda: torch.empty(10**14), lambda: torch.empty(2**62, 2**62), lambda: np.zeros(10**15)]
)
def test_more_memory_than_there_is_is_one_line(ask: object, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        guarded(ask)  # type: ignore[arg-type]
    assert stop.value.code == 2
    output, errors = capsys.readouterr()
    assert errors.startswith("error: these options need more memory than there is: choose smaller ones (")
    assert (output, errors.count("\n")) == ("", 1)


def test_other_errors_of_torch_keep_their_traceback() -> None:
    with pytest.raises(RuntimeError, match="must match the size"):
        guarded(lambda: torch.ones(2) + torch.ones(3))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_count_of_a_command_has_an_end(name: str) -> None:
    counts = [one for one in options(COMMANDS[name]) if one.type in (int, int | None) and one.default is not None]
    for one in counts:
        if one.about.minimum is not None and one.name != "minimum_objects":  # which collect compares with another
            with pytest.raises(UserError, match=f"^{one.name} must be "):
                check_value(one.name, 10**30, one.about, whole=True)
