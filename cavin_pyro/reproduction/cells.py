"""The cells of the paper's figure: a method and its planner in a task, with a reward and a number of objects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from cavin_pyro.reproduction.sizes import TOP_ROW_OBJECTS, Size

PLANNERS = ("paper", "ours")  # each has a figure of its own
SCENES_PER_TRAINING = 1000  # so that more episodes per cell can join those of an earlier run


@dataclass(frozen=True)
class Cell:
    """A bar of the figure, or a point of its bottom row, for one training: scenes `seed`, `seed + 1`, ..."""

    method: str
    planner: str
    task: str
    reward: str
    objects: int
    training_seed: int
    seed: int
    episodes: int

    @property
    def name(self) -> str:
        """As the name of its folder."""
        return f"{self.method}-{self.planner}-{self.task}-{self.reward}-{self.objects}-{self.training_seed}"


def cells(size: Size, methods: Sequence[str], planners: Sequence[str] = PLANNERS) -> Iterator[Cell]:
    """Every cell for every training seed, which has scenes of its own that all methods share.

    Top row: dense and sparse with 3 objects. Bottom row: sparse, against the number of objects.
    """
    objects = {"dense": (TOP_ROW_OBJECTS,), "sparse": size.object_counts}
    bars = [
        (method, planner, task, reward, count)
        for planner in planners
        for task in size.tasks
        for method in methods
        for reward in objects
        if reward in size.rewards
        for count in objects[reward]
    ]
    for bar in bars:
        episodes = size.episodes if bar[-1] == TOP_ROW_OBJECTS else size.bottom_episodes
        share = -(-episodes // len(size.training_seeds))
        for number, training_seed in enumerate(size.training_seeds):
            yield Cell(*bar, training_seed, size.first_scene + number * SCENES_PER_TRAINING, share)
