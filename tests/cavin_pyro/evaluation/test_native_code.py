"""`planner.compile=auto`, the default: who loads native code that is kept, and where it could give other plans."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.native_code import argument_compile
from models.priors.flow import FlowPrior

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize("command", ["plan", "evaluate", "demo"])
def test_only_plan_loads_native_code_by_itself(command: str) -> None:
    """Results of many episodes must not depend on what lies in one machine's cache."""
    assert command in COMMANDS
    assert compose(command).planner.compile == ("auto" if command == "plan" else False)
    assert compose(command, "planner.compile=true").planner.compile is True
    assert compose(command, "planner.compile=auto").planner.compile == ("auto" if command == "plan" else False)
    assert compose(command, "planner=paper").planner.compile is False
    assert "compile" not in compose(command, "planner=random").planner


def test_an_evaluation_has_the_same_folder_as_before_there_was_a_choice() -> None:
    assert compose("evaluate").output == compose("evaluate", "planner.compile=auto").output
    assert "clearing-sparse-3-cavin-0" in compose("evaluate", "task=clearing").output


@pytest.mark.parametrize(
    ("overrides", "device", "chosen"),
    [
        ("", CPU, "auto"),
        ("layout=1", CPU, "auto"),
        ("layout=generated generated.seed=3", CPU, "auto"),
        ("planner.optimizer=cem", CPU, "auto"),
        ("planner.compile=true", CPU, True),
        ("planner.compile=false", CPU, False),
        ("", GPU, False),
        ("layout=random", CPU, False),
        ("layout=generated", CPU, False),
        ("task=rearrange", CPU, False),
        ("matmul_precision=bfloat16", CPU, False),  # it would round at other places
        ("planner.warm_start=false", CPU, False),  # direct plans sample codes then, not noise
        ("planner.warm_start=false planner.compile=true", CPU, True),
    ],
)
def test_auto_is_false_where_native_code_would_change_plans(
    overrides: str, device: torch.device, chosen: bool | str
) -> None:
    config = compose("plan", *overrides.split())
    assert argument_compile(config, device, nn.Module(), Path("a.safetensors")) == chosen  # type: ignore[arg-type]


def test_auto_is_false_with_flows(small: SimpleNamespace) -> None:
    model = nn.ModuleList([FlowPrior(dimension=2, feature_dimension=4)])
    assert argument_compile(compose("plan"), CPU, model, Path("a.safetensors")) is False  # type: ignore[arg-type]
