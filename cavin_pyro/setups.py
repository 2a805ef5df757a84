"""From the words of `plan` and `evaluate` to an environment, a planner and a PointNet."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyro
import torch
from omegaconf import DictConfig, OmegaConf
from pyro.nn import PyroModule

from cavin_pyro.arithmetic import PRODUCTS, keep_freed_memory, set_products
from cavin_pyro.building import build_model, class_of, construct, pointnet_of
from cavin_pyro.checkpoint import default_checkpoint, load_checkpoint
from cavin_pyro.episode_reward import EpisodeReward
from cavin_pyro.episodes import Episode, run_episode
from cavin_pyro.errors import UserError, at_least, check_seed, one_of, user_input, whole_number
from cavin_pyro.worlds import check_world, object_ranges
from envs.layouts import Layout
from envs.pushing import PushingEnv
from envs.workspace import MAXIMUM_OBJECTS
from models.learned_priors import FlowPrior
from models.pointnet import PointNet
from planning import Planner
from planning.protocol import RewardFunction


@dataclass(frozen=True)
class Setup:
    """All that closed-loop episodes need; env belongs to this process."""

    env: PushingEnv
    planner: Planner
    pointnet: PointNet
    pushes_per_plan: int | None  # as of `cavin_pyro.episodes.run_episode`

    @property
    def layout(self) -> Layout:
        """Of the episode that the environment is in."""
        return self.env.layout

    def run_episode(self, seed: int, **options: Any) -> Episode:
        """As `cavin_pyro.episodes.run_episode`, whose other options these are."""
        return run_episode(
            self.env, self.planner, self.pointnet, seed=seed, pushes_per_plan=self.pushes_per_plan, **options
        )


def check_words(config: DictConfig) -> None:
    """Check what needs no checkpoint and no simulator.

    Raises:
        UserError: a number or name out of its range.
    """
    check_seed(config.seed)
    at_least("maximum_steps", config.maximum_steps, 1)
    one_of("products", config.products, PRODUCTS)
    whole_number("objects", config.objects, 1, MAXIMUM_OBJECTS)
    check_world(config.env)
    if config.layout == "random" and config.planner.get("compile"):
        raise UserError(
            "planner.compile=true makes code for one layout, and layout=random has another in every episode: "
            "take planner.compile=false"
        )


def tell_of_compiling(config: DictConfig) -> None:
    """One line on standard error where the first plan will take long, since nothing is seen meanwhile."""
    if config.planner.get("compile"):
        print("planner.compile=true: the first plan is compiled, which takes a minute or two", file=sys.stderr)


def set_up(config: DictConfig, *, render: bool = False) -> Setup:
    """Build environment and planner.

    Raises:
        UserError: unknown task or layout, a checkpoint that cannot be used, a planner that refuses its options.
    """
    check_words(config)
    set_products(config.products)
    keep_freed_memory()
    with user_input():
        tiles = OmegaConf.to_container(config.tiles)
        assert isinstance(tiles, dict)
        env = PushingEnv(
            task=config.task,
            layout=config.layout,
            tiles={str(name): value for name, value in tiles.items()},
            reward=config.reward,
            objects=config.objects,
            ranges=object_ranges(config.env),
            object_set=config.env.objects,
            assets=config.env.assets,
            maximum_steps=config.maximum_steps,
            camera=config.env.camera,
            segmentation=config.env.segmentation,
            render_mode="rgb_array" if render else None,
            robot=config.env.robot,
        )
    try:
        with user_input():
            reward = EpisodeReward(env, reward=config.reward, margin=config.margin)
        planner, pointnet = _planner(config, reward)
        if config.pushes_per_plan is not None:
            whole_number("pushes_per_plan", config.pushes_per_plan, 1, planner.segment_length)
        with user_input():  # tells at once whether every layout has room for the objects
            for number in range(len(env.layouts)):
                env.reset(seed=config.seed, options={"layout": number})
        if len(env.layouts) > 1:
            env.reset(seed=config.seed)  # in the layout that the seed draws
    except BaseException:
        env.close()
        raise
    return Setup(env, planner, pointnet, config.pushes_per_plan)


def _planner(config: DictConfig, reward: RewardFunction) -> tuple[Planner, PointNet]:
    path = Path(config.checkpoint or default_checkpoint())
    checkpoint = load_checkpoint(path, trust=list(config.trust))
    pointnet = pointnet_of(checkpoint, path)
    options = {str(name): value for name, value in config.planner.items()}
    if options.pop("model_free"):
        return construct(options), pointnet
    if "model" not in checkpoint.config:
        raise UserError(f"checkpoint {path} holds no model: give one that train has written")
    known = checkpoint.config["model"].get("maximum_objects", MAXIMUM_OBJECTS)
    if config.objects > known:
        raise UserError(f"objects={config.objects}, but checkpoint {path} knows at most {known}: use objects={known}")
    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    model = build_model(checkpoint.config)
    checkpoint.load_into("model", model, path)
    model.requires_grad_(False).eval()
    _check_planner(options, model, path)
    torch.manual_seed(config.seed)
    return construct(options, model=model, reward=reward), pointnet


def _check_planner(options: dict[str, Any], model: PyroModule, path: Path) -> None:
    """Make sure that the model has what the planner asks for, and no code that the planner would not choose.

    Raises:
        UserError: it has not; the model that has is named. Or it is to be compiled, and cannot.
    """
    planner = class_of(options)
    missing = [name for name in getattr(planner, "needs", ()) if not hasattr(model, name)]
    superfluous = [name for name in getattr(planner, "lacks", ()) if hasattr(model, name)]
    if missing or superfluous:
        what = f"has no {' and no '.join(missing)}" if missing else f"has {superfluous[0]} besides"
        raise UserError(
            f"{planner.__name__} needs a checkpoint of model={planner.usual_model}, but {path} holds "
            f"{type(model).__name__}, which {what}; planner=random takes any"
        )
    if options.get("compile") and any(isinstance(part, FlowPrior) for part in model.modules()):
        raise UserError(
            f"planner.compile=true, but the priors in {path} are flows, which cannot be compiled: take compile=false"
        )
