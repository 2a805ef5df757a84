"""From configuration to parts: models, priors, guides and planners, by their `_target_`."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

import yaml
from hydra.errors import InstantiationException
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig
from torch import nn

from cavin_pyro.config.composition import PRESETS
from cavin_pyro.config.errors import UserError, one_line, user_input
from cavin_pyro.config.options import constructor_options, shown
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.checks import check_kinds
from cavin_pyro.models.likelihoods import Scales
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.dynamics import Outcome
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.part import Part

KINDS = {"model": Model, "prior": nn.Module, "dynamics": Outcome, "scales": Scales, "autoencoder": nn.Module}
PARTS = ("model", "guide", "prior", "geometry", "dynamics", "scales", "objective")  # sections of a training
Config = Mapping[str, Any] | DictConfig
STANDARD_PRIOR = "cavin_pyro.models.priors.standard.StandardPrior"
MAY_BE_ZERO = ("_weight", "_margin", "warm_up_steps", "unit_features", "frequencies")  # ends of names
LARGEST_SIZE = 10**6  # more would fill the memory until the system kills the process, or take minutes to begin
FIXED_SCALES = {"_target_": "cavin_pyro.models.likelihoods.LikelihoodScales"}
PAPER_DYNAMICS = {"_target_": "cavin_pyro.models.networks.dynamics.Dynamics"}


def construct(config: Config, *arguments: Any, kind: type = object, **keywords: Any) -> Any:
    """Build the part that a configuration names; whatever its class raises becomes a `UserError` of one line.

    So does a part of another `kind`, a class, or a protocol with its methods.
    """
    if not config.get("_target_"):
        raise UserError(f"a part has no _target_, the class to build it from: {dict(config)}")
    try:
        if (own := class_of(config)) is None or _is_a(own, kind):
            # In two steps, because Hydra would turn keywords that are dataclasses into configuration.
            own = instantiate(config, _partial_=True, _convert_="all")(*arguments, **keywords)
            if _is_a(own, kind):
                return own
        raise UserError(f"{config['_target_']} is no {kind.__name__}: derive it from {kind.__module__}.{kind.__name__}")
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        cause = (isinstance(error, InstantiationException) and error.__cause__) or error
        said = "" if isinstance(cause, ValueError) else f"{config['_target_']} cannot be built: "
        raise UserError(said + one_line(cause)) from error


def _is_a(made: Any, kind: type) -> bool:
    """Whether a class, or an object, is one of a kind, or has a protocol's methods."""
    if getattr(kind, "_is_protocol", False):
        methods = [name for name, one in vars(kind).items() if inspect.isfunction(one) and not name.startswith("_")]
        return all(hasattr(made, name) for name in methods)
    return issubclass(made, kind) if isinstance(made, type) else isinstance(made, kind)


def check_sizes(section: str, config: Config, minimum: float = 1) -> None:
    """Raise a `UserError` for a number that is not finite, or a whole one out of range, but for those that may be 0."""
    if not isinstance(config, Mapping | DictConfig):
        raise UserError(
            f"{section} is a section of options, {section}.NAME=VALUE, which {shown(config)} cannot replace"
        )
    for name, value in config.items():
        option = f"{section}.{name!s}"
        if isinstance(value, Mapping | DictConfig):
            check_sizes(option, value, minimum)
        elif isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"{option} must be finite, not {value}")
        elif type(value) is int and not option.endswith(MAY_BE_ZERO) and value < minimum:
            raise UserError(f"{option} must be at least {minimum:g}, not {value}")
        elif type(value) is int and value > LARGEST_SIZE:
            raise UserError(f"{option} must be at most {LARGEST_SIZE}, not {value}")


def build_part(section: str, config: Config, *arguments: Any, **keywords: Any) -> Any:
    """Build the part of a section, which the line about what is wrong with it names."""
    check_sizes(section, config)
    with user_input(section):
        return construct(config, *arguments, kind=KINDS.get(section.rpartition(".")[2], object), **keywords)


@user_input("model", "prior", "scales", "dynamics")
def build_model(config: Config) -> Model:
    """The model program with its parts, from the sections `model`, `prior`, `scales` and `dynamics`.

    A model gets a prior for each of its codes, that is, for each of `effect_dimension` and `motion_dimension`
    that its section has: `model.prior` where that names a class, else the section `prior`. Without that section,
    `model` itself has the parts, as `describe` writes it. A part that cannot be built is a `UserError`. The section
    `space` is the world's; without it, the tabletop's.
    """
    check_kinds(config, dict.fromkeys(("space", *PARTS), Mapping | None))
    sizes, parts, kinds = dict(config["model"]), dict[str, Any](), list[str]()
    if "prior" in config:
        if missing := [name for name in ("_target_", "feature_dimension", "width") if name not in sizes]:
            raise UserError(f"the section model has no {', '.join(missing)}: give one that train has written")
        own_prior = sizes.pop("prior", None) or {}
        check_sizes("model", sizes)
        section = "model.prior" if own_prior.get("_target_") else "prior"
        space = construct(config["space"]) if config.get("space") else SPACE
        given = {"space": space, "feature_dimension": sizes["feature_dimension"]}
        kinds = [kind for kind in ("effect", "motion") if f"{kind}_dimension" in sizes]
        for kind in kinds:
            given["effect_dimension"] = sizes.get("effect_dimension") if kind == "motion" else None
            prior = own_prior if section == "model.prior" else config["prior"]
            parts[f"{kind}_prior"] = build_part(section, prior, dimension=sizes[f"{kind}_dimension"], **given)
        given = {"space": space, "feature_dimension": sizes["feature_dimension"], "width": sizes["width"]}
        parts["dynamics"] = build_part("dynamics", config.get("dynamics") or PAPER_DYNAMICS, **given)
        parts["scales"] = build_part("scales", config.get("scales") or FIXED_SCALES, space=space)
        parts["space"] = space
    model: Model = build_part("model", sizes, **parts)
    model.check_priors()
    if "prior" in config and not kinds and config["prior"].get("_target_") != STANDARD_PRIOR:
        raise UserError(f"model {type(model).__name__} has no codes and so no priors: leave prior=standard")
    return model


@user_input("guide")
def build_guide(config: Config, model: Model) -> Guide:
    """The guide program of a model, from the section `guide`; a `UserError` about another one lists those that fit."""
    target, kind = config["guide"].get("_target_"), class_of(config["guide"])
    fits = getattr(kind, "fits", ())
    if kind is not None and model.name not in fits:
        choices = ", ".join(name for name, guide in _guides().items() if model.name in guide.fits) or "none of ours"
        other = ", derive yours from cavin_pyro.guides.guide.Guide, "
        other += f"or choose guide=auto_normal guide.autoguide._target_={target}"
        raise UserError(
            f"guide {target} does not fit model {type(model).__name__} (it fits {', '.join(fits) or 'none'}): "
            f"choose guide= from {choices}{'' if issubclass(kind, Guide) else other}"
        )
    return build_part("guide", config["guide"], model)


def class_of(config: Config) -> Any:
    """The class of a part, None if there is no such class."""
    try:
        return get_class(config["_target_"])
    except (Exception, SystemExit):  # a user's module may raise anything; `construct` says it in one line
        return None


def amortized_guides(model_name: str) -> list[str]:
    """The choices of `guide=` that fit a model and infer any window."""
    return [name for name, guide in _guides().items() if model_name in guide.fits and guide.amortized]


def _guides() -> dict[str, type[Guide]]:
    """The classes of `guide=`."""
    files = sorted((PRESETS / "guide").glob("*.yaml"))
    return {file.stem: class_of(yaml.safe_load(file.read_text(encoding="utf-8"))) for file in files}


def describe(*, model: Model, guide: Guide | None = None, geometry: Geometry | None = None) -> dict[str, Any]:
    """The sections `model`, `guide` and `geometry`, from which the same parts can be built.

    A part that no file can describe, or whose class no other program can import, is a `UserError`.
    """
    if guide is not None and guide.model is not model:
        raise UserError("the guide was built for another model: give guide.model, or build a guide for this one")
    parts = {"model": model, "guide": guide, "geometry": geometry}
    none = {"geometry": {"_target_": None}} if geometry is None and model.space != SPACE else {}
    return none | {name: _described(part, name, model) for name, part in parts.items() if part is not None}


def _described(value: Any, place: str, model: Model) -> Any:
    """A part or one of its arguments as plain data; a guide's `model` is left out, as `build_guide` gives it."""
    if isinstance(value, Part):
        target = _dotted(type(value), place)
        named = {name: one.default for name, one in constructor_options(target).items() if one.default is not one.empty}
        named |= dict(zip(inspect.signature(type(value)).parameters, value.by_position, strict=False))
        given = {name: one for name, one in {**named, **value.by_keyword}.items() if one is not model}
        return {"_target_": target, **{name: _described(one, f"{place}.{name}", model) for name, one in given.items()}}
    if isinstance(value, type | functools.partial):
        function = value if isinstance(value, type) else value.func
        options = {} if isinstance(value, type) else value.keywords
        return {"_target_": _dotted(function, place), "_partial_": True, **options}
    if is_dataclass(value):
        described = {name: _described(one, f"{place}.{name}", model) for name, one in vars(value).items()}
        return {"_target_": _dotted(type(value), place), **described}
    if isinstance(value, list | tuple):
        return [_described(one, place, model) for one in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise UserError(
        f"{place} is a {type(value).__name__}, which a checkpoint cannot describe: derive it from "
        "cavin_pyro.models.part.Part, or give save(config=...) the sections of train"
    )


def _dotted(found: Any, place: str) -> str:
    """The path by which another program imports a class."""
    if found.__module__ == "__main__" or "<locals>" in found.__qualname__:
        raise UserError(
            f"{place} is of class {found.__qualname__}, which no other program can import: move it into a module, and "
            "name that in load(trust=[...])"
        )
    return f"{found.__module__}.{found.__qualname__}"
