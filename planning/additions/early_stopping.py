"""A search that stops when no candidate can become the best (our addition to Algorithm 1, lines 5 to 7)."""

from __future__ import annotations

from dataclasses import dataclass

from cavin_pyro.planning.additions.addition import Addition


@dataclass(frozen=True)
class EarlyStopping(Addition):
    """`shooting` stops early, which leaves the chosen plan as it is up to its end.

    Codes then follow from noise that is sampled beforehand, so seeds give other plans than without it.
    """

    stops_early = True
