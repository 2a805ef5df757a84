"""Factories: an environment, a planner and a runner of episodes, from the options of `plan` and `evaluate`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import pyro
import torch
from omegaconf import DictConfig

from cavin_pyro.config.commands import CHECKPOINTS
from cavin_pyro.config.composition import compose
from cavin_pyro.config.device import choose_device, set_matmul_precision
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.options import About, check_value
from cavin_pyro.config.parts import check_sizes, class_of, construct
from cavin_pyro.config.world import object_ranges, part_of, task_of, world_of
from cavin_pyro.envs.tabletop.layouts import GENERATED
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.tasks import GeneratedLayouts
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.envs.world import ACTION_DECIMALS, World
from cavin_pyro.evaluation.rollout import Episode, rollout
from cavin_pyro.models.checks import check_choice, check_kinds, parameters_of, typed
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.planning import Planner
from cavin_pyro.planning.additions import ADDITIONS, Addition
from cavin_pyro.planning.backends import GRAPHS
from cavin_pyro.planning.optimizers import Optimizer, Shooting
from cavin_pyro.planning.searching import SearchingPlanner
from cavin_pyro.storage.checkpoint import Checkpoint, load

CPU = torch.device("cpu")
PARTS_OF_WORLD = ("objects", "camera", "segmentation", "robot")


@dataclass(frozen=True)
class EpisodeRunner:
    """Runs closed-loop episodes with one environment and one planner, which plans on `device`.

    `env` belongs to this process.
    """

    env: World
    planner: Planner
    pushes_per_plan: int | None  # as in `cavin_pyro.evaluation.rollout.rollout`
    device: torch.device = CPU
    push_decimals: int | None = ACTION_DECIMALS  # as in `cavin_pyro.evaluation.rollout.rollout`

    def rollout(self, seed: int, **options: Any) -> Episode:
        """Run one episode; for the other options see `cavin_pyro.evaluation.rollout.rollout`."""
        usual = {name: getattr(self, name) for name in ("pushes_per_plan", "push_decimals", "device")}
        return rollout(self.env, self.planner, seed=seed, **(usual | options))


def planner_name(config: DictConfig) -> str:
    """The planner's class, and its optimizer's where it has one: "CavinPlanner, Shooting"."""
    parts = (config.planner, config.planner.get("optimizer") or {})
    return ", ".join(str(part["_target_"]).rpartition(".")[2] for part in parts if part.get("_target_"))


@typed(UserError)
def make_env(
    config: DictConfig | None = None, *, geometry: Geometry | None = None, render: bool = False, **options: Any
) -> World:
    """Build an environment as the command `plan` does.

    env = cavin_pyro.make_env(task="crossing", objects=3, env={"camera": "kinect2"}, geometry=trained.geometry)
    env = cavin_pyro.make_env(env="pusht")

    Args:
        config: of a command; by default that of `options`, which are the command's options of the task and the world:
            `task`, `layout`, `reward`, `objects`, `maximum_steps`, `env` and others.
        geometry: of the checkpoint, with which a world that sees point clouds makes states for its model.
        render: whether `env.render()` makes pictures, as `rollout(..., photograph=True)` needs them.

    Raises:
        UserError: an unknown task, layout or object, or a part of the world that lacks files.
    """
    if config is not None and options:
        raise UserError("make_env takes options by their names, such as task='crossing', or only a configuration")
    config = compose("plan", **options) if config is None else config
    if (world := world_of(config)) is not None:
        pictures = render and type(world).render is not World.render
        world.render_mode = "rgb_array" if pictures else None
        return world
    task, tiles = task_of(config)
    with user_input():
        parts = {name: part_of(name, config.env[name], config.env.assets) for name in PARTS_OF_WORLD}
        env = PushingEnv(
            task=task,
            tiles=tiles,
            generated=GeneratedLayouts(**config.generated),
            ranges=object_ranges(config.env),
            object_set=parts.pop("objects"),
            assets=config.env.assets,
            render_mode="rgb_array" if render else None,
            **{name: config[name] for name in ("layout", "reward", "criterion", "margin", "objects", "maximum_steps")},
            **parts,
        )
    env.geometry = geometry
    return env


@typed(UserError)
def make_planner(
    model: Any,
    planner: str | Mapping[str, Any] = "cavin",
    *,
    pushes_per_plan: int | None = 1,
    device: str = "cpu",
    seed: int = 0,
    **options: Any,
) -> Planner:
    """Build a planner as the command `plan` does.

    planner = cavin_pyro.make_planner(cavin_pyro.load("contact").model, "cavin", samples=256, horizon=30)

    Validation of distributions is switched off in this process, as it takes a good part of a plan's time.

    Args:
        model: with which it predicts; it is moved to `device`. None for `random`, which predicts nothing.
        planner: a choice of the option `planner`, or a section with `_target_`, a class of one's own.
        pushes_per_plan: as `rollout` executes them. seed: of what a planner's class samples when it is built.
        options: of the planner, such as `samples`, `horizon`, `optimizer`; `plan --help=all` lists them as `planner.*`.

    Raises:
        UserError: an unknown planner or option, or a model that lacks what the planner needs.
    """
    if not planner:
        raise UserError("planner must be a choice of the option, or a section with _target_, not empty")
    given = {f"planner.{name}": value for name, value in options.items()}
    shared = {"pushes_per_plan": pushes_per_plan, "device": device, "seed": seed}
    config = compose("plan", planner=planner, **shared, **given)
    return planner_of(config, model, choose_device(config.device))


def planner_of(
    config: DictConfig, model: Model | None, device: torch.device, *, action_dimension: int = SPACE.actions
) -> Planner:
    """The planner of a configuration; for `model` and errors see `make_planner`."""
    options = {str(name): value for name, value in config.planner.items()}
    options.pop("default_checkpoint", None)  # which `config.checkpoint` has taken, unless the user named another
    given: dict[str, Any] = {"action_dimension": action_dimension}
    if not options.pop("model_free", False):
        if not isinstance(model, torch.nn.Module):
            name = planner_name(config)
            raise UserError(f"{name} needs a model: give cavin_pyro.load(NAME).model, or planner=random")
        pyro.settings.set(validate_distributions_pyro=False, validate_distributions_torch=False)
        _check_planner(options, model.to(device))
        if options.get("feature_weight", 0.0) is None:  # features count as positions do, by the likelihood's scales
            options["feature_weight"] = (model.space.center_scale / model.space.feature_scale) ** 2
        if options.get("compile") is True and device.type == "cuda":
            options["compile"] = GRAPHS
        torch.manual_seed(config.seed)
        optimizers, additions = _optimizers(options), _additions(options, one_push=config.pushes_per_plan == 1)
        given = {"model": model, "additions": additions, "decimals": config.get("push_decimals"), **optimizers}
    with user_input("planner"):
        planner: Planner = construct(options, kind=Planner, **given)
        if config.pushes_per_plan is not None:  # a plan has as many pushes as are to be executed
            check_value("pushes_per_plan", config.pushes_per_plan, About("", minimum=1, maximum=planner.segment_length))
    return planner


@user_input("planner", "checkpoint", "task", "tiles", "env", "layout", "generated", "pushes_per_plan")
def make_runner(config: DictConfig, *, render: bool = False) -> EpisodeRunner:
    """Build an environment and a planner, and run episodes with them; a layout without room is a `UserError`."""
    device = choose_device(config.device)
    check_sizes("planner", config.planner, minimum=-math.inf)  # its class knows the least numbers
    unread = [name for name, usual in asdict(GeneratedLayouts()).items() if config.generated[name] != usual]
    if unread and config.layout != GENERATED:
        raise UserError(f"generated.{unread[0]} is an option of layout=generated: give that, or leave it out")
    set_matmul_precision(config.matmul_precision)
    env = make_env(config, render=render)
    model_free, model = config.planner.get("model_free"), None
    try:
        if env.sees_clouds or not model_free:
            trained = load(config.checkpoint, trust=list(config.trust))
            check_space(trained, env)
            model = None if model_free else trained.model
            env.geometry = trained.geometry  # on the CPU, so that states are the same for every device
        planner = planner_of(config, model, device, action_dimension=env.space.actions)
        with user_input():
            env.check_starts(config.seed)  # fails now, not in a later episode
    except BaseException:
        env.close()
        raise
    return EpisodeRunner(env, planner, config.pushes_per_plan, device, config.get("push_decimals"))


def check_space(trained: Checkpoint, env: World) -> None:
    """Raise a `UserError` if a checkpoint was trained in a world of other dimensions or units."""
    if "model" in trained.config and trained.model.space != env.space:
        own = (trained.config.get("world") or {}).get("_target_", "another world")
        own = "env=tabletop" if trained.model.space == SPACE else own
        raise UserError(
            f"checkpoint {trained.path} was trained in {own}, whose actions, positions or units are "
            f"not those of {type(env).__name__}: choose another checkpoint, or its env"
        )


@user_input("planner")
def _additions(options: dict[str, Any], *, one_push: bool) -> list[Addition]:
    """Take the additions out of a planner's options, and build them.

    `planner.add` adds more, of which one replaces another of its class, and `planner.drop` leaves some out.
    """
    kinds = {"additions": Sequence[str | Mapping], "add": Sequence[str | Mapping], "drop": Sequence[str]}
    given = {name: options.pop(name, None) or [] for name in kinds}
    given = {name: [one] if isinstance(one, str) else one for name, one in given.items()}
    check_kinds(given, kinds)
    for option, entries in given.items():
        if len({str(entry) for entry in entries}) < len(entries):
            raise UserError(f"planner.{option}: one of {', '.join(map(str, entries))} is given twice")
    for name in itertools.chain(*given.values()):
        if isinstance(name, str):
            check_choice("addition", name, ADDITIONS)
    made: dict[type, Addition] = {}
    for entry in (*given["additions"], *given["add"]):
        addition = ADDITIONS[entry]() if isinstance(entry, str) else construct(entry, kind=Addition)
        made[type(addition)] = addition
    for name in given["drop"]:
        if made.pop(ADDITIONS[name], None) is None:
            raise UserError(f"planner.drop=[{name}]: this planner has no such addition")
    return [addition for addition in made.values() if one_push or not getattr(addition, "for_one_push", False)]


def _optimizers(options: dict[str, Any]) -> dict[str, Any]:
    """Take the optimizers that are sections out of a planner's options, and build them.

    `planner.optimizer._target_=my_lab.Mine` replaces the class and leaves `replacement`, an option of `Shooting`, which
    a class of the user's gets only if it takes it.
    """
    built = {}
    usual = {field.name for field in fields(Shooting)}
    for name in ("optimizer", "motion_optimizer"):
        section = options.get(name)
        if isinstance(section, DictConfig):
            taken = parameters_of(class_of(section))
            given = {str(key): value for key, value in section.items() if key in taken or key not in usual}
            with user_input("planner"):
                built[name] = construct(given, kind=Optimizer)
            del options[name]
    return built


def _check_planner(options: dict[str, Any], model: Model) -> None:
    """Make sure that the model has what the planner asks for, and no code that the planner would not choose."""
    planner = class_of(options)
    searches = isinstance(planner, type) and issubclass(planner, SearchingPlanner)
    if searches and (violation := planner.requires.violation(model)) is not None:
        wanted = planner.requires.model
        fitting = "|".join(name for name, (model_name, _) in CHECKPOINTS.items() if model_name == wanted)
        choice = f"choose checkpoint={fitting}, or " if fitting else "choose "
        raise UserError(
            f"{planner.__name__} needs a checkpoint of model={wanted}, not {type(model).__name__}, "
            f"which {violation}: {choice}planner=random, which takes any"
        )
