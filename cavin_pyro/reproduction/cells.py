"""The cells of the paper's figure, and how large a reproduction is: data, training, scenes and episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

TASKS = ("clearing", "insertion", "crossing")
REWARDS = ("dense", "sparse")
OBJECT_COUNTS = (1, 2, 3, 4, 5)
TOP_ROW_OBJECTS = 3  # objects in the top row of the paper's figure, dense and sparse
PLANNERS = ("paper", "ours")  # each has a figure of its own
SCENES_PER_TRAINING = 1000  # so that more episodes per cell can join those of an earlier run


@dataclass(frozen=True)
class Size:
    """Numbers of a reproduction.

    Attributes:
        transitions: pushes to collect, for all methods alike. training_seeds: trainings of each method.
        episodes: per cell of the top row. bottom_episodes: per cell of the bottom row. Both are shared by the training
            seeds; each of them gets scenes of its own, which are the same for all methods.
        first_scene: seed of the first scene; no other run uses these scenes. The training seed at place i has those
            from first_scene + 1000 i on.
        priors: of methods with codes; N(0, I), `standard`, is the paper's.
        collection, pretraining, training, planning: overrides of `collect`, `pretrain`, `train` and `evaluate`.
    """

    transitions: int
    training_seeds: tuple[int, ...]
    episodes: int
    bottom_episodes: int
    first_scene: int
    tasks: tuple[str, ...] = TASKS
    object_counts: tuple[int, ...] = OBJECT_COUNTS
    rewards: tuple[str, ...] = REWARDS
    priors: str = "conditional"
    collection: tuple[str, ...] = ()
    pretraining: tuple[str, ...] = ()
    training: tuple[str, ...] = ()
    planning: tuple[str, ...] = ()


TINY_TRAINING = (
    "trainer.steps=20",
    "trainer.validate_every=10",
    "trainer.batch_size=16",
    "trainer.validation_windows=32",
    "windows.minimum_move=0.001",
    "windows.validation_fraction=0.3",
)
QUICK_TRAINING = (
    "trainer.learning_rate=1e-3",
    "trainer.schedule=cosine",
    "trainer.batch_size=256",
    "trainer.batches=bucketed",
    "trainer.matmul_precision=bfloat16",
    "trainer.patience=100",
    "windows.negative_fraction=0.5",
)

SIZES: dict[str, Size] = {
    "smoke": Size(  # to see that everything runs, in minutes; its success rates mean nothing
        transitions=100,
        training_seeds=(0,),
        episodes=1,
        bottom_episodes=1,
        first_scene=50_000,
        priors="standard",
        collection=("episodes_per_shard=5",),
        pretraining=("clouds=100", "steps=2", "batch_size=8"),
        training=TINY_TRAINING,
        planning=("planner.samples=8", "planner.horizon=6", "maximum_steps=2"),
    ),
    "small": Size(
        transitions=20_000,
        training_seeds=(0, 1),
        episodes=10,
        bottom_episodes=4,
        first_scene=60_000,
        pretraining=("clouds=20000", "steps=2000"),
        training=(*QUICK_TRAINING, "trainer.steps=4000"),
    ),
    "medium": Size(  # half a day on two cores, with trainings long enough to compare the methods
        transitions=200_000,
        training_seeds=(0, 1, 2),
        episodes=60,
        bottom_episodes=30,
        first_scene=90_000,
        training=(*QUICK_TRAINING, "trainer.steps=36000"),
    ),
    "paper": Size(  # its data, prior, learning rate and steps
        transitions=500_000,
        training_seeds=(0, 1, 2, 3, 4),
        episodes=1_000,
        bottom_episodes=300,
        first_scene=100_000,
        priors="standard",
    ),
}


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
