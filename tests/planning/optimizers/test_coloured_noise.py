"""Coloured noise of iCEM."""

from __future__ import annotations

import pytest
import torch

from planning.optimizers.improved_cross_entropy import coloured


@pytest.mark.parametrize("segments", [1, 2, 5, 10])
@pytest.mark.parametrize("exponent", [0.0, 0.5, 2.0])
def test_every_number_keeps_mean_zero_and_variance_one(segments: int, exponent: float) -> None:
    white = torch.randn(1, 40_000, segments, 1, generator=torch.Generator().manual_seed(0))
    noise = coloured(white, exponent)[0, ..., 0]
    torch.testing.assert_close(noise.mean(0), torch.zeros(segments), rtol=0, atol=0.03)
    torch.testing.assert_close(noise.var(0), torch.ones(segments), rtol=0, atol=0.04)


def test_the_correlation_of_neighbouring_segments_grows_with_the_exponent() -> None:
    white = torch.randn(1, 20_000, 10, 1, generator=torch.Generator().manual_seed(0))
    noises = [coloured(white, exponent) for exponent in (0.0, 1.0, 3.0)]
    correlation = [(noise[:, :, :-1] * noise[:, :, 1:]).mean().item() for noise in noises]
    assert abs(correlation[0]) < 0.02
    assert 0.1 < correlation[1] < correlation[2] < 1.0


def test_power_falls_with_the_frequency_as_the_exponent_says() -> None:
    white = torch.randn(1, 40_000, 10, 1, generator=torch.Generator().manual_seed(0))
    power = torch.fft.rfft(coloured(white, 2.0)[0, ..., 0], dim=1).abs().square().mean(0)
    torch.testing.assert_close(power[1] / power[2:5], torch.tensor([4.0, 9.0, 16.0]), rtol=0.1, atol=0)
