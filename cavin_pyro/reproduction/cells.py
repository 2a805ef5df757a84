"""The cells of the paper's figure: a method and its planner in a task, with a reward and a number of objects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from cavin_pyro.reproduction.scales import TOP_ROW_OBJECTS, Scale


@dataclass(frozen=True)
class Cell:
    """One bar of the figure, or one point of its bottom row."""

    method: str
    planner: str
    task: str
    reward: str
    objects: int

    @property
    def name(self) -> str:
        """As part of a folder's name."""
        return f"{self.method}-{self.planner}-{self.task}-{self.reward}-{self.objects}"


@dataclass(frozen=True)
class Evaluation:
    """The episodes of a cell for one training. Scenes have the seeds `seed`, `seed + 1`, ..."""

    cell: Cell
    training_seed: int
    seed: int
    episodes: int

    @property
    def name(self) -> str:
        """As the name of its folder."""
        return f"{self.cell.name}-{self.training_seed}"


def cells(scale: Scale, methods: Sequence[str]) -> Iterator[Cell]:
    """Top row: dense and sparse with 3 objects. Bottom row: sparse, against the number of objects."""
    for planner in scale.planners:
        for task in scale.tasks:
            for method in methods:
                yield Cell(method, planner, task, "dense", TOP_ROW_OBJECTS)
                for objects in scale.object_counts:
                    yield Cell(method, planner, task, "sparse", objects)


def evaluations(scale: Scale, methods: Sequence[str]) -> Iterator[Evaluation]:
    """Every cell for every training seed. A training seed has scenes of its own, which all methods share."""
    for cell in cells(scale, methods):
        total = scale.episodes if cell.objects == TOP_ROW_OBJECTS else scale.bottom_episodes
        share = -(-total // len(scale.training_seeds))
        for number, training_seed in enumerate(scale.training_seeds):
            yield Evaluation(cell, training_seed, scale.first_scene + number * share, share)
