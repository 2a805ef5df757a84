"""What each part of the criticism is given, and what it hands back for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure
from pyro.nn import PyroModule

from cavin_pyro.collection import CollectionSettings
from models.pointnet import PointNet
from models.state import Window


@dataclass(frozen=True)
class Subject:
    """What is criticised.

    Attributes:
        model, guide: trained, in evaluation mode, without gradients. pointnet: makes the features of new clouds.
        training: windows `[B]` that training saw. validation: windows `[B]` of episodes that were held out. In
            both every window counts for all terms (`sequence_mask` is set everywhere).
        seed: of everything random. world: in which new episodes are made.
    """

    model: PyroModule
    guide: PyroModule
    pointnet: PointNet
    training: Window
    validation: Window
    seed: int = 0
    world: CollectionSettings = field(default_factory=CollectionSettings)

    @property
    def codes(self) -> tuple[str, ...]:
        """Names of the model's latent sites: effect_code, motion_code, one of them, or none."""
        return tuple(
            name for name in ("effect_code", "motion_code") if hasattr(self.model, name.replace("code", "prior"))
        )


@dataclass(frozen=True)
class Table:
    """Numbers to read: `rows`, each with one entry per column of `header`; floats are shown with `digits`."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    digits: int = 3


@dataclass(frozen=True)
class Picture:
    """A figure, and the sentence below it that says what to see in it."""

    name: str  # file name without ending
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Section:
    """One part of the report.

    Attributes:
        name: key in report.json. title: heading. explanation: what was measured, on what, and how to read it.
        findings: a sentence each, of what this run has shown, made from the values.
        values: for report.json: numbers, strings, lists and dictionaries of them.
    """

    name: str
    title: str
    explanation: str
    findings: Sequence[str]
    values: Mapping[str, Any]
    tables: Sequence[Table] = field(default_factory=tuple)
    pictures: Sequence[Picture] = field(default_factory=tuple)
