"""The cells of the paper's figure: a method and its planner in a task, with a reward and a number of objects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.scales import TOP_ROW_OBJECTS, Scale

FIGURES = ("paper", "ours")  # kinds of planners that have a figure of their own
PLANNERS = (*FIGURES, "variants")
# Between one method of the paper's figure and another: what each step of the way brings.
VARIANTS = (
    ("cavin", "first_segment"),
    ("cavin", "one_motion"),
    ("cavin", "without_effects"),
    ("sectar", "perturbed_rollouts"),
)
SCENES_PER_TRAINING = 1000  # so that more episodes per cell can join those of an earlier run


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


def cells(scale: Scale, methods: Sequence[str], planners: Sequence[str] = PLANNERS) -> Iterator[Cell]:
    """Of every kind of planner in `planners`; see `PLANNERS`.

    Top row: dense and sparse with 3 objects. Bottom row: sparse, against the number of objects. Variants: sparse, with
    3 objects.
    """
    for planner in planners:
        for task in scale.tasks:
            if planner == "variants":
                chosen = [one for one in VARIANTS if one[0] in methods and "sparse" in scale.rewards]
                yield from (Cell(*one, task, "sparse", TOP_ROW_OBJECTS) for one in chosen)
                continue
            for method in methods:
                if "dense" in scale.rewards:
                    yield Cell(method, planner, task, "dense", TOP_ROW_OBJECTS)
                if "sparse" in scale.rewards:
                    yield from (Cell(method, planner, task, "sparse", objects) for objects in scale.object_counts)


def evaluations(scale: Scale, methods: Sequence[str], planners: Sequence[str] = PLANNERS) -> Iterator[Evaluation]:
    """Every cell for every training seed. A training seed has scenes of its own, which all methods share."""
    for cell in cells(scale, methods, planners):
        top = cell.objects == TOP_ROW_OBJECTS and cell.planner in FIGURES
        share = -(-(scale.episodes if top else scale.bottom_episodes) // len(scale.training_seeds))
        for number, training_seed in enumerate(scale.training_seeds):
            yield Evaluation(cell, training_seed, scale.first_scene + number * SCENES_PER_TRAINING, share)


def in_order(rows: Sequence[Mapping[str, Any]], scale: Scale) -> list[Any]:
    """Rows of a table in the order of `evaluations` of all methods and planners, whatever was run first."""
    places = {cell: place for place, cell in enumerate(cells(scale, list(METHODS)))}

    def place(row: Mapping[str, Any]) -> tuple[int, int, int]:
        cell = Cell(row["method"], row["planner"], row["task"], row["reward"], row["objects"])
        return places[cell], row["training_seed"], row["seed"]

    return sorted(rows, key=place)
