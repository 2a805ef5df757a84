"""Optimizers of training: Adam, or Muon for matrices and Adam for the rest."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

OPTIMIZERS = ("adam", "muon")
SMALLEST = 5  # rows and columns of a matrix whose update Muon orthogonalises, at least


def make_optimizers(
    name: str, parameters: Sequence[nn.Parameter], learning_rate: float
) -> dict[str, torch.optim.Optimizer]:
    """One of `OPTIMIZERS` as its parts, by name; all of them take every step with the same learning rate.

    Muon makes the singular values of each matrix's update alike (Jordan et al., 2024), scaled so that the update is as
    large as Adam's usually is (Liu et al., 2025, arXiv:2502.16982), so that a learning rate of Adam's fits. It does not
    fit vectors, such as biases, or layers of a few outputs.
    """
    matrices = [one for one in parameters if name == "muon" and one.dim() == 2 and min(one.shape) >= SMALLEST]
    chosen = {id(one) for one in matrices}
    others = [one for one in parameters if id(one) not in chosen]
    made: dict[str, torch.optim.Optimizer] = {}
    if matrices:
        made["muon"] = torch.optim.Muon(matrices, lr=learning_rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    if others:
        made["adam"] = torch.optim.Adam(others, lr=learning_rate, fused=True)
    return made
