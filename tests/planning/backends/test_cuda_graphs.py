"""CUDA graphs without a GPU: a stand-in captures by remembering the function. `tests/cavin_pyro/devices` uses a GPU."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from planning.backends import capture as capturing
from planning.backends import cuda_graphs
from planning.backends.cuda_graphs import CudaGraphs
from planning.backends.signature import flatten, unflatten


class Pair(NamedTuple):
    first: Tensor
    second: Tensor | None


@pytest.fixture
def captured(monkeypatch: pytest.MonkeyPatch) -> list[Callable[[], Any]]:
    """The functions that were captured. A replay writes over the one result that a graph has, as a GPU's does."""
    functions: list[Callable[[], Any]] = []

    def capture(function: Callable[[], Any], device: torch.device, pool: Any) -> tuple[Any, Any]:
        result = function()
        functions.append(function)

        def replay() -> None:
            ours: list[Tensor] = []
            theirs: list[Tensor] = []
            flatten(result, ours, [])
            flatten(function(), theirs, [])
            for one, other in zip(ours, theirs, strict=True):
                one.copy_(other)

        return SimpleNamespace(replay=replay), result

    monkeypatch.setattr(capturing, "capture", capture)
    monkeypatch.setattr(cuda_graphs, "DEVICE", "cpu")
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: None)
    return functions


def shifted(numbers: Tensor, by: int, factor: float) -> Pair:
    return Pair((numbers + by) * factor, None)


def test_a_function_is_captured_once_for_its_constants_and_shapes(captured: list[Callable[[], Any]]) -> None:
    backend, numbers = CudaGraphs(), torch.arange(3.0)
    for by in range(3):  # a whole number is an input, not a constant
        assert backend(shifted, numbers, by, 2.0).first.equal((numbers + by) * 2)
    assert len(captured) == 1
    assert backend(shifted, numbers, 1, 3.0).first.equal((numbers + 1) * 3) and len(captured) == 2
    assert backend(shifted, numbers[:2], 1, 3.0).first.equal((numbers[:2] + 1) * 3) and len(captured) == 3


def test_a_result_stays_when_the_graph_runs_again(captured: list[Callable[[], Any]]) -> None:
    backend = CudaGraphs()
    first = backend(shifted, torch.zeros(2), 1, 1.0)
    backend(shifted, torch.ones(2), 5, 1.0)
    assert first.first.tolist() == [1.0, 1.0] and len(captured) == 1


def test_weights_are_read_where_they_are(captured: list[Callable[[], Any]]) -> None:
    backend, layer = CudaGraphs(), torch.nn.Linear(2, 2)

    def layered(inputs: Tensor) -> Tensor:
        return layer(inputs)

    inputs = torch.randn(3, 2)
    with torch.no_grad():
        before = backend(layered, inputs)
        layer.weight.mul_(2.0)
        assert not backend(layered, inputs).equal(before) and backend(layered, inputs).equal(layer(inputs))


def test_graphs_that_were_not_used_for_the_longest_time_go_first(
    captured: list[Callable[[], Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda_graphs, "MOST", 2)
    backend = CudaGraphs()
    for count in (1, 2, 1, 3):  # 2 goes
        backend(shifted, torch.zeros(count), 0, 1.0)
    assert len(captured) == 3
    backend(shifted, torch.zeros(1), 0, 1.0)
    assert len(captured) == 3
    backend(shifted, torch.zeros(2), 0, 1.0)
    assert len(captured) == 4


def test_what_cannot_be_captured_runs_eagerly_and_says_so_once(
    captured: list[Callable[[], Any]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: Any) -> Any:
        raise RuntimeError("called a synchronizing CUDA operation\nat great length")

    monkeypatch.setattr(capturing, "capture", refuse)
    backend = CudaGraphs()
    for count in (1, 2):
        assert backend(shifted, torch.zeros(count), 1, 1.0).first.tolist() == count * [1.0]
    assert capsys.readouterr().err == (
        "shifted runs eagerly, since it cannot be captured as a CUDA graph: called a synchronizing CUDA operation\n"
    )


def test_tensors_on_the_cpu_are_refused() -> None:
    with pytest.raises(ValueError, match="compile=cuda_graphs needs a model and a state on a GPU, and shifted got"):
        CudaGraphs()(shifted, torch.zeros(2), 1, 1.0)


def test_models_are_told_that_shapes_must_not_depend_on_values(captured: list[Callable[[], Any]]) -> None:
    model = SimpleNamespace(told=[])

    class Told:
        def __enter__(self) -> None:
            model.told.append(len(captured))

        def __exit__(self, *_: Any) -> None:
            model.told.append(len(captured))

    backend = CudaGraphs(Told)  # type: ignore[arg-type]
    backend(shifted, torch.zeros(2), 0, 1.0)
    backend(shifted, torch.zeros(2), 1, 1.0)
    assert model.told == [0, 1]  # while it was captured, and never again


def test_arguments_are_flat_tensors_and_return_as_they_were() -> None:
    arguments = (Pair(torch.ones(2), None), 3, (torch.zeros(1), "name"), True)
    tensors: list[Tensor] = []
    signature: list[Any] = []
    flatten(arguments, tensors, signature)
    assert [tensor.tolist() for tensor in tensors] == [[1.0, 1.0], 3, [0.0]]
    again = unflatten(arguments, iter(tensors))
    assert isinstance(again[0], Pair) and again[0].first is tensors[0] and again[0].second is None
    assert again[1].item() == 3 and again[2] == (tensors[2], "name") and again[3] is True
    other: list[Any] = []
    flatten((Pair(torch.ones(2), None), 4, (torch.zeros(1), "name"), True), [], other)
    assert other == signature
