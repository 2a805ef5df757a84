"""iCEM, a sample-efficient cross-entropy method (Pinneri et al., CoRL 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from planning import fields
from planning.candidates import Candidates, Search, join
from planning.inputs import check_fraction, check_positive, check_weight
from planning.optimisers.cross_entropy import refit
from planning.optimisers.weights import Tried, best, share


@dataclass(frozen=True)
class ImprovedCrossEntropy:
    """The cross-entropy method with kept elites and noise that is coloured over a plan's segments.

    Of the published method: coloured noise, elites that compete again in the next iteration, and the mean as a
    candidate of the last. Not: elites carried over from the last plan, for a plan here depends on its own state and
    seed only.

    iterations, elites, inertia, replacement: as `CrossEntropy`. kept: fraction of the elites that compete again.
    exponent: the noise's power falls as frequency^-exponent; 0 is white, 2 makes neighbouring segments alike.

    Raises ValueError for counts below 1 and numbers outside of their range.
    """

    iterations: int = 4
    elites: float = 0.1
    inertia: float = 0.1
    kept: float = 0.3
    exponent: float = 0.5
    replacement: bool = True

    def __post_init__(self) -> None:
        check_positive("iterations", self.iterations)
        check_fraction("elites", self.elites, positive=True)
        check_fraction("inertia", self.inertia)
        check_fraction("kept", self.kept)
        check_weight("exponent", self.exponent)

    def optimise(self, search: Search, samples: int) -> Candidates:
        """All N = `samples` plans `[B, N]` that were considered; the last one is the last mean, unless that died."""
        mean = scale = None
        elites: Tried | None = None
        considered = []
        for number in range(self.iterations):
            count = share(samples, self.iterations, number)
            noise = coloured(search.noise(count), self.exponent)
            if mean is not None and scale is not None:
                noise = mean + scale * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = search.evaluate(noise, replacement=self.replacement)
            considered.append(candidates)
            wanted = max(1, round(self.elites * count))
            tried = Tried(candidates.noise, candidates.returns)
            if elites is not None:  # predictions repeat exactly: elites compete again at no cost
                tried = fields.join([best(elites, round(self.kept * wanted)), tried])
            elites = best(tried, wanted)
            mean, scale = refit(elites, mean, scale, self.inertia)
        return join(considered)


def coloured(noise: Tensor, exponent: float) -> Tensor:
    """White noise `[B, n, K, D]` made coloured over its K segments, each number still of variance 1.

    Its power falls as frequency^-exponent (Timmer and Koenig 1995); the lowest frequency, which is zero, has the
    power of the next one.
    """
    segments = noise.shape[2]
    if segments == 1 or exponent == 0:
        return noise
    frequencies = torch.fft.rfftfreq(segments, device=noise.device, dtype=noise.dtype)
    frequencies[0] = frequencies[1]
    gain = frequencies.pow(-exponent / 2.0)
    mirrored = torch.full_like(gain, 2.0)  # but for the ends, frequencies stand for two
    mirrored[0] = 1.0
    if segments % 2 == 0:
        mirrored[-1] = 1.0
    gain = gain / ((mirrored * gain.square()).sum() / segments).sqrt()
    spectrum = torch.fft.rfft(noise, dim=2) * gain[:, None]
    return torch.fft.irfft(spectrum, n=segments, dim=2)
