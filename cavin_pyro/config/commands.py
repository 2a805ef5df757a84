"""The options of every command, each declared once: type, default, meaning, unit and range."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, field
from typing import Any

from cavin_pyro.config.options import option, preset_defaults, seed_option
from cavin_pyro.envs.tabletop.objects.sampling import ObjectRanges
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.tasks.generated import ANY_SHAPE, SHAPES, GeneratedLayouts
from cavin_pyro.envs.tabletop.workspace import MAXIMUM_OBJECTS, OBJECT_SLOTS, TILE_SIDE
from cavin_pyro.envs.world import ACTION_DECIMALS

CHECKPOINTS = {  # names of shipped checkpoints, with the model and the guide of each
    **dict.fromkeys(("cavin", "kinect", "held_out", "contact"), ("cascaded", "cascaded")),
    "sectar": ("single_latent", "single_latent"),
    "cvae_mpc": ("flat", "flat"),
    "mpc": ("dynamics", "none"),
}
DEFAULT_CHECKPOINT = "cavin"
PAPER_TASKS = ["clearing", "insertion", "crossing"]
SECTIONS = ("elbo", "guide", "prior", "predictive", "intervals", "subgoals")  # of the report of check
COLLECTION_CLEARANCE = 0.12  # metres; collected scenes are denser than those of an episode
ENV = {name: one.default for name, one in inspect.signature(PushingEnv).parameters.items()}
GENERATED, RANGES = GeneratedLayouts(), ObjectRanges()

# Meanings of options of several commands.
CHECKPOINT = f"checkpoint: a shipped one ({', '.join(CHECKPOINTS)}), or the path of one from train"
DATA = "dataset folder from collect, or several: data=[data/one,data/two]"
FOLDER = "folder for the results, in which an unfinished run resumes; by default one in runs/"
CRITERION = "which violations end an episode: those of the paper's text, or of its code"
HELD_OUT = "names of objects, [mug,banana]; training omits what shows one of them"
PRECISION = "precision of the factors of matrix products; bfloat16 is TF32 on a GPU"
TRUST = "modules of your own whose classes the checkpoint may name"
ENVS, REPRODUCE = "cavin_pyro.envs.tabletop", "cavin_pyro.reproduction"  # where the choices of options are listed
MARGIN = "margin of the planner's reward"
PRECISIONS = "cavin_pyro.config.device.MATMUL_PRECISIONS"


@dataclass
class DeviceOptions:
    """Where networks run."""

    device: str = option("cpu", "where networks run; auto takes a GPU if there is one", choices=("auto", "cpu", "cuda"))


@dataclass
class LaunchOptions:
    """Where episodes are run; results do not depend on it, apart from times."""

    workers: int = option(2, "processes; results do not depend on it, apart from times", minimum=1, maximum=1024)


@dataclass
class RangesConfig:
    """Distributions of objects and their parameters (section `env.ranges`; presets `env/ranges=`)."""

    names: list[str] | None = option(None, "objects to sample from; by default all of env.objects")
    target: list[str] | None = option(None, "objects to sample the target from; by default those of names")
    scale: list[float] = option(list(RANGES.scale), "factor on each object's size: low, high")
    mass: list[float] = option(list(RANGES.mass), "factor on each object's own mass: low, high")
    kilograms: list[float] | None = option(None, "mass of every object, not a factor: low, high", unit="kilograms")
    friction: list[float] = option(list(RANGES.friction), "Coulomb coefficient of friction: low, high")
    clearance: float = option(RANGES.clearance, "least distance of centres at the start", unit="metres", minimum=0)
    drop_height: float = option(RANGES.drop_height, "height of objects' drop", unit="metres", minimum=0, maximum=10)


@dataclass
class WorldConfig:
    """The section `env`: robot, objects, camera and segmentation, by name or as a class of the user's own."""

    robot: Any = option(ENV["robot"], "robot that pushes", choices=f"{ENVS}.robots.ROBOTS")
    objects: Any = option(ENV["object_set"], "set of objects", choices=f"{ENVS}.objects.object_sets.OBJECT_SETS")
    camera: Any = option(ENV["camera"], "depth camera", choices=f"{ENVS}.sensors.CAMERAS")
    segmentation: Any = option(
        ENV["segmentation"], "segmentation of depth images", choices=f"{ENVS}.segmentation.SEGMENTERS"
    )
    assets: str | None = option(None, "folder of meshes, for object sets and robots that need one")
    ranges: RangesConfig = field(default_factory=RangesConfig)


def collection_world() -> WorldConfig:
    """The world for the collection of random pushes."""
    return WorldConfig(ranges=RangesConfig(clearance=COLLECTION_CLEARANCE))


@dataclass
class CollectionOptions:
    """Options that determine the collected episodes, apart from their world."""

    seed: int = seed_option("root of all randomness")
    steps: int = option(10, "pushes per episode", minimum=1)
    intent_length: int = option(5, "pushes in a row that share a target object and a direction", minimum=1)
    perturbation_rate: float = option(0.3, "fraction of pushes with a perturbed start", minimum=0, maximum=1)
    minimum_objects: int = option(1, "objects on the table, at least", minimum=1)
    maximum_objects: int = option(OBJECT_SLOTS, "objects, at most", minimum=1, maximum=MAXIMUM_OBJECTS)
    episodes_per_shard: int = option(50, "episodes per file, the unit of resuming", minimum=1, maximum=10_000)


@dataclass
class CollectConfig(LaunchOptions, CollectionOptions):
    """Options of `python -m cavin_pyro.collect`."""

    defaults: list[Any] = preset_defaults("env/ranges=paper world=tabletop")
    transitions: int = option(100_000, "pushes to collect, at least; whole files of episodes are written", minimum=1)
    output: str | None = option(None, "folder for the dataset, in which an unfinished one resumes; by default in data/")
    env: WorldConfig = field(default_factory=collection_world)
    world: Any = None


@dataclass
class TrainerConfig:
    """How to train (section `trainer`)."""

    steps: int = option(1_000_000, "gradient steps, at most", minimum=1)
    batch_size: int = option(64, "windows per step", minimum=1)
    learning_rate: float = option(1e-4, "learning rate of Adam", positive=True)
    schedule: str = option("constant", "of the learning rate; cosine ends at 1 %", choices=("constant", "cosine"))
    batches: str = option("mixed", "bucketed: one number of objects in each", choices=("mixed", "bucketed"))
    matmul_precision: str = option("float32", PRECISION, choices=PRECISIONS)
    cuda_graphs: bool = option(True, "on a GPU, replay each step's loss and gradients as one CUDA graph")
    clip_norm: float = option(250.0, "largest norm of the gradient of the mean loss per window", positive=True)
    reflect: bool = option(
        False, "mirror every other window, at random, where the world says how; on the table with geometry=outline"
    )
    validate_every: int = option(1000, "steps between validations, at which a killed run can resume", minimum=1)
    validation_windows: int = option(4096, "windows per validation, at most", minimum=1)
    patience: int = option(20, "validations without a new best before training stops", minimum=1)

    def rate(self, step: int) -> float:
        """The learning rate of a step, from 0."""
        if self.schedule == "constant":
            return self.learning_rate
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / self.steps)))


@dataclass
class WindowConfig:
    """Selection of windows and transitions for training (section `windows`; the published implementation)."""

    validation_fraction: float = option(0.1, "share of the episodes for validation", positive=True, maximum=0.99)
    maximum_step: float = option(0.2, "most that an object moves in a transition for f", unit="metres", positive=True)
    minimum_move: float = option(0.1, "least move of a window's farthest object, for h, g", unit="metres", minimum=0)
    maximum_move: float = option(0.5, "largest such move; all pushes are also safe", unit="metres", minimum=0)
    negative_fraction: float = option(0.25, "share of the other windows that f also learns", minimum=0, maximum=1)
    held_out_objects: list[str] = option([], HELD_OUT)


@dataclass
class TrainConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.train`."""

    defaults: list[Any] = preset_defaults(
        "model=cascaded guide=cascaded prior=standard geometry=pointnet "
        "dynamics=paper scales=fixed objective=trace_elbo"
    )
    data: Any = option("data/pushes", DATA)
    output: str | None = option(None, FOLDER)
    pointnet: str = option(DEFAULT_CHECKPOINT, "for geometry=pointnet: a shipped checkpoint, or one from pretrain")
    initial: str | None = option(None, "checkpoint whose weights training starts from, by name or path")
    trained: list[str] = option([], "parts that change, [dynamics], while others stay as they are; by default all")
    model: Any = None
    guide: Any = None
    prior: Any = None
    geometry: Any = None
    dynamics: Any = None
    scales: Any = None
    objective: Any = None
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    seed: int = seed_option("seed of weights, split, batches and codes")


@dataclass
class PretrainConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.pretrain`."""

    defaults: list[Any] = preset_defaults("autoencoder=pointnet")
    data: Any = option("data/pushes", DATA)
    output: str | None = option(None, FOLDER)
    seed: int = seed_option()
    clouds: int = option(60_000, "point clouds of the dataset, one in ten for validation", minimum=2)
    held_out_objects: list[str] = option([], HELD_OUT)
    steps: int = option(6000, "gradient steps", minimum=1)
    batch_size: int = option(128, "clouds per step", minimum=1)
    learning_rate: float = option(1e-3, "learning rate of Adam", positive=True)
    autoencoder: Any = None


@dataclass
class CheckConfig:
    """Options of `python -m cavin_pyro.check`."""

    defaults: list[Any] = preset_defaults("sizes=default env/ranges=paper world=tabletop")
    checkpoint: str = option(DEFAULT_CHECKPOINT, CHECKPOINT)
    trust: list[str] = option([], TRUST)
    data: Any = option("data/pushes", f"{DATA}; preferably the model's training data")
    output: str | None = option(None, FOLDER)
    seed: int = seed_option()
    windows: int = option(1000, "held-out windows, and as many training windows", minimum=1)
    sections: list[str] | None = option(None, "sections of the report; by default all", choices=SECTIONS)
    sizes: Any = None
    env: WorldConfig = field(default_factory=collection_world)
    world: Any = None


@dataclass
class TilesConfig:
    """Fields of the layout to replace, for example `tiles.goal=[[1,2]]` (section `tiles`)."""

    region: Any = option(None, "tiles of the region")
    goal: Any = option(None, "tiles of the goal")
    target_start: Any = option(None, "tiles where the target may start")
    obstacle_start: Any = option(None, "tiles where the other objects may start")


@dataclass
class GeneratedConfig:
    """What is wanted of `layout=generated` (section `generated`)."""

    tiles: int = option(GENERATED.tiles, "4 to 14 tiles of the bridge, of the region, or of the way to the slot (to 8)")
    shape: str = option(GENERATED.shape, f"shape of the bridge or of the region: {', '.join((*SHAPES, ANY_SHAPE))}")


@dataclass
class SceneConfig:
    """Options of commands that begin episodes of one task."""

    defaults: list[Any] = preset_defaults("env/ranges=paper world=tabletop task=" + ENV["task"])
    layout: int | str = option(ENV["layout"], "number, random (per episode), generated (generated.*), or a YAML file")
    reward: str = option(ENV["reward"], "reward of the task", choices=("dense", "sparse"))
    criterion: str = option(ENV["criterion"], CRITERION, choices=f"{ENVS}.tasks.reward.CRITERIA")
    objects: int = option(ENV["objects"], "objects on the table", minimum=1, maximum=MAXIMUM_OBJECTS)
    maximum_steps: int = option(ENV["maximum_steps"], "pushes per episode, at most", minimum=1)
    task: Any = None
    tiles: TilesConfig = field(default_factory=TilesConfig)
    margin: float = option(ENV["margin"], MARGIN, unit="metres", minimum=0, maximum=TILE_SIDE / 2)
    checkpoint: str = option("contact", CHECKPOINT)
    trust: list[str] = option([], TRUST)
    generated: GeneratedConfig = field(default_factory=GeneratedConfig)
    world: Any = None
    env: WorldConfig = field(default_factory=WorldConfig)
    seed: int = seed_option("seed of the scene, and of what is sampled in it")


@dataclass
class EpisodeConfig(SceneConfig, DeviceOptions):
    """Options of commands that run episodes of one task."""

    defaults: list[Any] = preset_defaults("planner=cavin env/ranges=paper world=tabletop task=" + ENV["task"])
    planner: Any = None
    pushes_per_plan: int | None = option(1, "executed pushes per plan; null: all T (Algorithm 1, line 11)", minimum=1)
    push_decimals: int | None = option(ACTION_DECIMALS, "decimals of executed pushes; null: all", minimum=1, maximum=6)
    matmul_precision: str = option("float32", PRECISION, choices=PRECISIONS)
    checkpoint: str = option("${oc.select:planner.default_checkpoint,cavin}", f"{CHECKPOINT}; by default the planner's")
    seed: int = seed_option("seed of the scene and of the planner")


@dataclass
class ImagineConfig(SceneConfig):
    """Options of `python -m cavin_pyro.imagine`."""

    output: str | None = option(None, "folder for the results; by default one in runs/")
    effects: int = option(8, "effect codes c ~ p(c | s) of the scene", minimum=1, maximum=100)
    motions: int = option(4, "motion codes z ~ p(z | s, c) of each effect", minimum=1, maximum=100)


@dataclass
class PlanConfig(EpisodeConfig):
    """Options of `python -m cavin_pyro.plan`."""

    output: str | None = option(None, "folder for the results; by default one in runs/")
    video: bool = option(True, "write a video of the episode")
    video_format: str = option("mp4", "of the video; gif and webp move on web pages", choices=("mp4", "gif", "webp"))
    viewer: str = option("none", "live: a page on which the goal is moved by hand", choices=("none", "live"))
    port: int = option(8080, "where viewer=live listens, on 127.0.0.1 alone; 0: any", minimum=0, maximum=65535)


@dataclass
class EvaluateConfig(LaunchOptions, EpisodeConfig):
    """Options of `python -m cavin_pyro.evaluate`."""

    output: str | None = option(None, FOLDER)
    episodes: int = option(200, "episodes, with seeds seed, seed + 1, ...", minimum=1)
    shard: str = option("1/1", "i/n: the i-th of every n episodes, so that n machines share the work")


@dataclass
class ReproduceConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.reproduce`."""

    defaults: list[Any] = preset_defaults("")
    scale: str = option("smoke", "how large: minutes (smoke) to days (paper)", choices=f"{REPRODUCE}.sizes.SIZES")
    methods: list[str] = option(
        ["cavin", "sectar", "cvae_mpc", "mpc"],
        "methods; contact is CAVIN with networks that see contact",
        choices=f"{REPRODUCE}.methods.METHODS",
    )
    priors: str | None = option(None, "priors of codes; by default the scale's", choices=("standard", "conditional"))
    planners: list[str] = option(["paper", "ours"], "kinds of planners", choices=f"{REPRODUCE}.cells.PLANNERS")
    tasks: list[str] = option(PAPER_TASKS, "tasks", choices=f"{REPRODUCE}.sizes.TASKS")
    objects: list[int] = option(
        [1, 2, 3, 4, 5], "numbers of objects with sparse rewards", choices=f"{REPRODUCE}.sizes.OBJECT_COUNTS"
    )
    rewards: list[str] = option(["dense", "sparse"], "rewards of the tasks", choices=f"{REPRODUCE}.sizes.REWARDS")
    episodes: int | None = option(None, "episodes per cell of the top row; by default the scale's", minimum=1)
    bottom_episodes: int | None = option(None, "episodes per cell of the bottom row; by default the scale's", minimum=1)
    first_scene: int | None = option(None, "seed of the first scene; by default the scale's", minimum=0)
    models: str | None = option(None, "folder of trained models, METHOD-SEED.safetensors; nothing is trained then")
    output: str | None = option(None, FOLDER)
    workers: int = option(2, "processes; the table does not depend on it", minimum=1)
    shard: str = option("1/1", "i/n: the i-th of every n trainings and their episodes; rerun in the joined folders")
    table: str | None = option(None, "a table of episodes, episodes.parquet, to draw and count; nothing is run then")


@dataclass
class QuickstartConfig(LaunchOptions):
    """Options of `python -m cavin_pyro.quickstart`."""

    defaults: list[Any] = preset_defaults("world=tabletop")
    minutes: int = option(20, "how long it takes on two idle cores, on the tabletop", minimum=3, maximum=120)
    episodes: int = option(20, "episodes of each task, to see what comes out", minimum=1)
    output: str | None = option(None, FOLDER)
    world: Any = None
    seed: int = seed_option("seed of data and training")


COMMANDS: dict[str, type] = {
    "quickstart": QuickstartConfig,
    "collect": CollectConfig,
    "pretrain": PretrainConfig,
    "train": TrainConfig,
    "check": CheckConfig,
    "plan": PlanConfig,
    "imagine": ImagineConfig,
    "evaluate": EvaluateConfig,
    "reproduce": ReproduceConfig,
}
