"""Options of the commands that run episodes: plan, evaluate and demo."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from cavin_pyro.config.commands.device import DeviceOptions
from cavin_pyro.config.commands.launching import LaunchOptions
from cavin_pyro.config.commands.world import ENVIRONMENT, WorldConfig
from cavin_pyro.config.options import MAXIMUM_SEED, option, seed_option
from envs.tasks.generated import ANY_SHAPE, FEWEST, MOST, OBSTACLES, SHAPES, GeneratedLayouts
from envs.workspace import MAXIMUM_OBJECTS, PUSH_DECIMALS, TILE_SIDE

CHECKPOINTS = {  # names of shipped checkpoints, with the model and the guide of each
    "cavin": ("cascaded", "cascaded"),
    "kinect": ("cascaded", "cascaded"),
    "held_out": ("cascaded", "cascaded"),
    "contact": ("cascaded", "cascaded"),
    "sectar": ("single_latent", "single_latent"),
    "cvae_mpc": ("flat", "flat"),
    "mpc": ("dynamics", "none"),
}
DEFAULT_CHECKPOINT = "cavin"
GENERATED = asdict(GeneratedLayouts())
DEFAULTS: list[Any] = ["_self_", {"task": ENVIRONMENT["task"]}, {"planner": "cavin"}, {"env/ranges": "paper"}, "base"]


@dataclass
class TilesConfig:
    """Fields of the layout to replace, for example `tiles.goal=[[1,2]]` (section `tiles`)."""

    region: Any = option(None, "tiles of the region", group="task")
    goal: Any = option(None, "tiles of the goal", group="task")
    target_start: Any = option(None, "tiles where the target may start", group="task")
    obstacle_start: Any = option(None, "tiles where the other objects may start", group="task")


@dataclass
class GeneratedConfig:
    """What is wanted of `layout=generated` (section `generated`)."""

    tiles: int = option(
        GENERATED["tiles"],
        "number of tiles of the bridge, of the region to clear, or of the way to the slot (at most 8); more are harder",
        minimum=FEWEST,
        maximum=MOST,
        group="task",
    )
    shape: str = option(
        GENERATED["shape"],
        "shape of the bridge, or of the region, which may also be a block; winding has more than two turns",
        choices=(*SHAPES, ANY_SHAPE),
        group="task",
    )
    obstacles: str = option(
        GENERATED["obstacles"], "where obstacles start, on or beside the bridge", choices=OBSTACLES, group="task"
    )
    seed: int | None = option(
        GENERATED["seed"],
        "seed of one layout for all scenes; null generates one for each scene, from the scene's seed",
        minimum=0,
        maximum=MAXIMUM_SEED,
        group="task",
    )


@dataclass
class EpisodeConfig(DeviceOptions):
    """Common options of commands that run episodes."""

    defaults: list[Any] = field(default_factory=lambda: [*DEFAULTS])
    task: Any = None
    layout: int | str = option(
        ENVIRONMENT["layout"],
        "number of one of the task's layouts, random (one per episode), generated (as generated.* say), or the path "
        "of a YAML file",
        group="task",
    )
    tiles: TilesConfig = field(default_factory=TilesConfig)
    generated: GeneratedConfig = field(default_factory=GeneratedConfig)
    reward: str = option(ENVIRONMENT["reward"], "reward of the task", choices=("dense", "sparse"), group="task")
    criterion: str = option(
        ENVIRONMENT["criterion"],
        "what ends an episode as a violation: strict, the paper's text; published, the published implementation, "
        "which tolerates 1.5 tiles beside the bridge and everything in insertion",
        choices="envs.tasks.CRITERIA",
        group="task",
    )
    objects: int = option(
        ENVIRONMENT["objects"], "objects on the table", minimum=1, maximum=MAXIMUM_OBJECTS, group="task"
    )
    maximum_steps: int = option(
        ENVIRONMENT["maximum_steps"], "pushes per episode, at most", minimum=1, group="task", limit=10_000
    )
    planner: Any = None
    pushes_per_plan: int | None = option(
        1, "executed pushes per plan; null executes all T (paper, Algorithm 1, line 11)", group="planning"
    )
    push_decimals: int | None = option(
        PUSH_DECIMALS,
        "decimals to which planned pushes are rounded, so that an episode does not depend on how a machine rounds; "
        "null executes them as planned",
        minimum=1,
        limit=6,
        group="planning",
    )
    margin: float = option(
        0.02,
        "safety margin of the planner's reward, at most half a tile; predictions err by about this much; 0 also allows "
        "dead ends",
        unit="metres",
        minimum=0,
        maximum=TILE_SIDE / 2,
        group="planning",
    )
    matmul_precision: str = option(
        "float32",
        "precision of the factors of matrix products in plans; bfloat16 is TF32 on a GPU",
        choices="cavin_pyro.config.numerics.MATMUL_PRECISIONS",
        group="planning",
    )
    checkpoint: str = option(
        f"${{oc.select:planner.default_checkpoint,{DEFAULT_CHECKPOINT}}}",
        f"checkpoint to plan with: a shipped one ({', '.join(CHECKPOINTS)}), or the path of one from train; by default "
        "the planner's own, such as sectar for planner=sectar",
        group="model",
    )
    trust: list[str] = option([], "modules of your own whose classes the checkpoint may name", group="model")
    env: WorldConfig = field(default_factory=WorldConfig)
    seed: int = seed_option("seed of the scene and of the planner", group="run")


@dataclass
class PlanConfig(EpisodeConfig):
    """Options of `python -m cavin_pyro.plan`."""

    defaults: list[Any] = field(default_factory=lambda: [*DEFAULTS, "cached_native_code"])
    output: str | None = option(None, "folder for the results; by default a separate one in runs/plan", group="run")
    video: bool = option(True, "write a video of the episode", group="run")
    save_goal: str | None = option(
        None,
        "file for the episode's last scene, as a goal for task=rearrange: a depth image (.png) or point clouds "
        "(.safetensors)",
        group="run",
    )
    viewer: str | None = option(
        None, "further viewer; rerun writes a recording in 3D, episode.rrd, and needs the extra .[viewer]", group="run"
    )


@dataclass
class EvaluateConfig(LaunchOptions, EpisodeConfig):
    """Options of `python -m cavin_pyro.evaluate`."""

    output: str | None = option(
        None,
        "folder for the results, in which an unfinished evaluation resumes; by default a separate one in runs/evaluate",
        group="run",
    )
    episodes: int = option(200, "episodes, with seeds seed, seed + 1, ...", minimum=1, group="run", limit=10**6)
    workers: int = option(
        2,
        "processes; results do not depend on it, apart from planning times",
        minimum=1,
        group="run",
        limit=1024,
    )
    compare: str | None = option(
        None, "folder of another evaluation of the same scenes, to compare episode by episode", group="run"
    )
    shard: str = option("1/1", "i/n: the i-th of every n episodes, so that n machines share the work", group="run")
    merge: list[str] = option([], "folders of finished shards, [a,b], whose episodes are joined", group="run")


@dataclass
class DemoConfig(EpisodeConfig):
    """Options of `python -m cavin_pyro.demo`."""

    output: str | None = option(
        None, "folder for the results, with a subfolder per task; by default runs/demo", group="run"
    )
    tasks: list[str] = option(
        ["clearing", "insertion", "crossing"], "tasks to run", choices="envs.tasks.TASKS", group="task"
    )
    seed: int = option(1, "seed of the scenes and of the planner", minimum=0, maximum=MAXIMUM_SEED, group="run")
