"""Options of the commands that run episodes: plan, evaluate and demo."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from cavin_pyro.config.commands.device import DeviceOptions, LaunchOptions
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
DEFAULTS: list[Any] = ["_self_", {"planner": "cavin"}, {"env/ranges": "paper"}, "base"]


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

    tiles: int = option(
        GENERATED["tiles"],
        "number of tiles of the bridge, of the region to clear, or of the way to the slot (at most 8); more are harder",
        minimum=FEWEST,
        maximum=MOST,
    )
    shape: str = option(
        GENERATED["shape"],
        "shape of the bridge, or of the region, which may also be a block; winding has more than two turns",
        choices=(*SHAPES, ANY_SHAPE),
    )
    obstacles: str = option(GENERATED["obstacles"], "where obstacles start, on or beside the bridge", choices=OBSTACLES)
    seed: int | None = option(
        GENERATED["seed"],
        "seed of one layout for all scenes; null generates one for each scene, from the scene's seed",
        minimum=0,
        maximum=MAXIMUM_SEED,
    )


@dataclass
class SceneConfig(DeviceOptions):
    """Options of commands that run episodes of one task or of several."""

    defaults: list[Any] = field(default_factory=lambda: [*DEFAULTS])
    layout: int | str = option(
        ENVIRONMENT["layout"],
        "number of one of the task's layouts, random (one per episode), generated (as generated.* say), or the path "
        "of a YAML file",
    )
    reward: str = option(ENVIRONMENT["reward"], "reward of the task", choices=("dense", "sparse"))
    criterion: str = option(
        ENVIRONMENT["criterion"],
        "what ends an episode as a violation: strict, the paper's text; published, the published implementation, "
        "which tolerates 1.5 tiles beside the bridge and everything in insertion",
        choices="envs.tasks.CRITERIA",
    )
    objects: int = option(ENVIRONMENT["objects"], "objects on the table", minimum=1, maximum=MAXIMUM_OBJECTS)
    maximum_steps: int = option(ENVIRONMENT["maximum_steps"], "pushes per episode, at most", minimum=1)
    planner: Any = None
    pushes_per_plan: int | None = option(
        1, "executed pushes per plan; null executes all T (paper, Algorithm 1, line 11)"
    )
    push_decimals: int | None = option(
        PUSH_DECIMALS,
        "decimals to which planned pushes are rounded, so that an episode does not depend on how a machine rounds; "
        "null executes them as planned",
        minimum=1,
        maximum=6,
    )
    margin: float = option(
        0.02,
        "safety margin of the planner's reward, at most half a tile; predictions err by about this much; 0 also allows "
        "dead ends",
        unit="metres",
        minimum=0,
        maximum=TILE_SIDE / 2,
    )
    matmul_precision: str = option(
        "float32",
        "precision of the factors of matrix products in plans; bfloat16 is TF32 on a GPU",
        choices="cavin_pyro.config.numerics.MATMUL_PRECISIONS",
    )
    checkpoint: str = option(
        f"${{oc.select:planner.default_checkpoint,{DEFAULT_CHECKPOINT}}}",
        f"checkpoint to plan with: a shipped one ({', '.join(CHECKPOINTS)}), or the path of one from train; by default "
        "the planner's own, such as sectar for planner=sectar",
    )
    trust: list[str] = option([], "modules of your own whose classes the checkpoint may name")
    generated: GeneratedConfig = field(default_factory=GeneratedConfig)
    env: WorldConfig = field(default_factory=WorldConfig)
    seed: int = seed_option("seed of the scene and of the planner")


@dataclass
class EpisodeConfig(SceneConfig):
    """Options of commands that run episodes of one task."""

    defaults: list[Any] = field(default_factory=lambda: [*DEFAULTS, {"task": ENVIRONMENT["task"]}])
    task: Any = None
    tiles: TilesConfig = field(default_factory=TilesConfig)


@dataclass
class PlanConfig(EpisodeConfig):
    """Options of `python -m cavin_pyro.plan`."""

    output: str | None = option(None, "folder for the results; by default a separate one in runs/plan")
    video: bool = option(True, "write a video of the episode")
    save_goal: str | None = option(
        None,
        "file for the episode's last scene, as a goal for task=rearrange: a depth image (.png) or point clouds "
        "(.safetensors)",
    )
    viewer: str | None = option(
        None, "further viewer; rerun writes a recording in 3D, episode.rrd, and needs the extra .[viewer]"
    )


@dataclass
class EvaluateConfig(LaunchOptions, EpisodeConfig):
    """Options of `python -m cavin_pyro.evaluate`."""

    output: str | None = option(
        None,
        "folder for the results, in which an unfinished evaluation resumes; by default a separate one in runs/evaluate",
    )
    episodes: int = option(200, "episodes, with seeds seed, seed + 1, ...", minimum=1)
    compare: str | None = option(None, "folder of another evaluation of the same scenes, to compare episode by episode")
    shard: str = option("1/1", "i/n: the i-th of every n episodes, so that n machines share the work")
    merge: list[str] = option([], "folders of finished shards, [a,b], whose episodes are joined")


@dataclass
class DemoConfig(SceneConfig):
    """Options of `python -m cavin_pyro.demo`."""

    output: str | None = option(None, "folder for the results, with a subfolder per task; by default runs/demo")
    tasks: list[str] = option(["clearing", "insertion", "crossing"], "tasks to run", choices="envs.tasks.TASKS")
    seed: int = seed_option("seed of the scenes and of the planner", default=1)
