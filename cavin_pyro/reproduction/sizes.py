"""How large a reproduction is: data, training, scenes and episodes."""

from __future__ import annotations

from dataclasses import dataclass

TASKS = ("clearing", "insertion", "crossing")
REWARDS = ("dense", "sparse")
OBJECT_COUNTS = (1, 2, 3, 4, 5)
TOP_ROW_OBJECTS = 3  # objects in the top row of the paper's figure, dense and sparse


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
    "small": Size(  # two to three hours on two cores for the paper's planners and three objects
        transitions=40_000,
        training_seeds=(0, 1, 2),
        episodes=60,
        bottom_episodes=30,
        first_scene=60_000,
        pretraining=("clouds=20000", "steps=2000"),
        training=(*QUICK_TRAINING, "trainer.steps=12000"),
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
