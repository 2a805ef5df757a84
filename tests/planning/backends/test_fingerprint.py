"""Fingerprints tell apart what decides native code, and are equal in every process."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import nn

from envs.layouts import load_task
from envs.tasks import TaskReward
from planning.backends.fingerprint import UnknownValueError, fingerprint


class Point(NamedTuple):
    x: float
    y: float


class OtherPoint(NamedTuple):
    x: float
    y: float


@dataclass(frozen=True)
class Scale:
    factor: float


class Slotted:
    __slots__ = ("__secret", "number")

    def __init__(self, number: int, secret: int = 0) -> None:
        self.number = number
        self.__secret = secret


class Array(np.ndarray):
    """Has attributes, and numbers that are none of them."""


def network(*, bias: bool = True, seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, 4, bias=bias), nn.ReLU())


def changed(name: str, value: Any) -> nn.Module:
    found = network()
    if name == "weight":
        with torch.no_grad():
            found[0].weight[2, 1] += value
    else:
        setattr(found, name, value)
    return found


def times(factor: float) -> Any:
    return lambda number: factor * number


def plus(summand: float) -> Any:
    return lambda number: summand + number


DIFFERENT = [
    *(None, True, False, 1, 0, 1.0, 0.0, -0.0, "1", b"1", (), (1,), (1, 2), ((1,), 2), [1], {"a": 1}, {"b": 1}, {1}),
    *(float, int, torch.float32, torch.bfloat16, torch.device("cpu")),
    *(torch.zeros(2), torch.zeros(2, 1), torch.zeros(2).double(), torch.tensor([0.0, 1e-45]), torch.zeros(0)),
    *(
        Point(1.0, 2.0),
        OtherPoint(1.0, 2.0),
        Point(1.0, 3.0),
        Scale(1.0),
        Scale(2.0),
        Slotted(1),
        Slotted(2),
        Slotted(1, 1),
    ),
    *(network(), network(bias=False), network(seed=1), changed("weight", 1e-6), changed("factor", 2.0)),
    *(changed("factor", 3.0), nn.Sequential(nn.Linear(3, 4), nn.Tanh())),
    *(times(2.0), times(3.0), plus(2.0), partial(max, 1), partial(max, 2), Point(1.0, 2.0)._asdict, network, times),
    *([1].append, [2].append, torch.neg, torch.abs),
    *(TaskReward(load_task("crossing", 1)), TaskReward(load_task("crossing", 2)), TaskReward(load_task("clearing", 1))),
    *(TaskReward(load_task("crossing", 1), margin=0.01), TaskReward(load_task("crossing", 1), reward="dense")),
]


def test_values_that_differ_have_different_fingerprints() -> None:
    found = [fingerprint([value]) for value in DIFFERENT]
    assert len(set(found)) == len(found)


def test_equal_values_have_equal_fingerprints() -> None:
    assert fingerprint([network()]) == fingerprint([network()])
    assert fingerprint([times(2.0)]) == fingerprint([times(2.0)])
    assert fingerprint([TaskReward(load_task("crossing", 1))]) == fingerprint([TaskReward(load_task("crossing", 1))])
    strided = torch.arange(6.0).reshape(2, 3).t().contiguous().t()
    assert fingerprint([strided]) == fingerprint([strided.contiguous()])


def test_what_was_only_computed_does_not_count(toy: SimpleNamespace) -> None:
    task = load_task("crossing", 1)
    before = fingerprint([task, toy.PointMass()])
    TaskReward(task)(torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1, dtype=torch.bool))
    assert fingerprint([task, toy.PointMass()]) == before


def test_a_cycle_ends() -> None:
    one, other = SimpleNamespace(), SimpleNamespace()
    one.other, other.other = other, one
    assert fingerprint([one]) == fingerprint([other]) != fingerprint([SimpleNamespace(other=one)])


@pytest.mark.parametrize(
    "value", [torch.Generator(), iter([1]), object(), torch.eye(2).to_sparse(), np.zeros(2).view(Array)]
)
def test_a_state_that_nobody_sees_has_no_fingerprint(value: object) -> None:
    with pytest.raises(UnknownValueError):
        fingerprint([{"inside": value}])


@pytest.mark.soak
def test_fingerprints_are_equal_in_every_process_until_a_source_changes(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from beside import helper\ndef mine(x):\n    return helper(x)\n")
    (tmp_path / "beside.py").write_text("def helper(x):\n    return x + 1\n")
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); import torch, mine; from envs.layouts import load_task\n"
        "from planning.backends.fingerprint import fingerprint; from planning import CavinPlanner\n"
        "torch.manual_seed(0); layer = torch.nn.Linear(2, 3)\n"
        "print(fingerprint([mine.mine, layer, {'b', 'a'}, load_task('crossing', 1), CavinPlanner]))"
    )

    def run(seed: int) -> str:
        return subprocess.run(
            [sys.executable, "-c", script, str(tmp_path)],
            env={**os.environ, "PYTHONHASHSEED": str(seed), "PYTHONPATH": os.getcwd(), "PYTHONDONTWRITEBYTECODE": "1"},
            check=True,
            capture_output=True,
            text=True,
        ).stdout

    first = run(1)
    assert run(2) == first
    (tmp_path / "beside.py").write_text("def helper(x):\n    return x + 2\n")
    assert run(1) != first
