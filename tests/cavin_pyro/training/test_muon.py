from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from cavin_pyro.training.optimizers import OPTIMIZERS, SMALLEST, make_optimizers

RATE = 0.01


def layers() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(12, 20), nn.ReLU(), nn.Linear(20, SMALLEST - 1), nn.LayerNorm(SMALLEST - 1))


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_every_weight_has_one_optimizer(name: str) -> None:
    parameters = list(layers().parameters())
    made = make_optimizers(name, parameters, RATE)
    held = [one for optimizer in made.values() for group in optimizer.param_groups for one in group["params"]]
    assert sorted(map(id, held)) == sorted(map(id, parameters))


def test_muon_has_the_matrices_but_those_of_few_outputs() -> None:
    module = layers()
    (group,) = make_optimizers("muon", list(module.parameters()), RATE)["muon"].param_groups
    assert [id(one) for one in group["params"]] == [id(module[0].weight)]
    assert set(make_optimizers("adam", list(module.parameters()), RATE)) == {"adam"}
    assert set(make_optimizers("muon", [nn.Parameter(torch.zeros(30))], RATE)) == {"adam"}


def test_directions_of_small_gradients_move_as_far_as_those_of_large_ones() -> None:
    weight = nn.Parameter(torch.zeros(12, 20))
    (left, _), (right, _) = (torch.linalg.qr(torch.randn(size, 12)) for size in (12, 20))
    sizes = torch.logspace(0, -1, 12)  # singular values of the gradient
    weight.grad = left @ torch.diag(sizes) @ right.T
    make_optimizers("muon", [weight], RATE)["muon"].step()
    moved = torch.diagonal(left.T @ weight.detach() @ right) / (-RATE * 0.2 * math.sqrt(20))
    assert moved.min() > 0.6 and moved.max() < 1.3
    adam = nn.Parameter(torch.zeros(12, 20))
    adam.grad = weight.grad
    make_optimizers("adam", [adam], RATE)["adam"].step()
    # Both updates are about as large: Adam's by the rate in each number, Muon's by a fifth of it.
    assert 0.1 < weight.detach().square().mean().sqrt() / adam.detach().square().mean().sqrt() < 0.3


def test_muon_makes_no_decay() -> None:
    weight = nn.Parameter(torch.ones(8, 8))
    weight.grad = torch.zeros(8, 8)
    make_optimizers("muon", [weight], RATE)["muon"].step()
    assert torch.equal(weight.detach(), torch.ones(8, 8))
