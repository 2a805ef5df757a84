"""From a command's name and overrides to its configuration, or to one line about the wrong override."""

from __future__ import annotations

import copy
import difflib
import functools
import hashlib
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from numbers import Number
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.errors import UserError, one_line
from cavin_pyro.config.options import check_options, flat_options, options, shown, with_defaults
from cavin_pyro.models.checks import told

PRESETS = Path(__file__).parent / "presets"
OUTPUT = {  # the folder of a run for which the user names none
    "collect": "data/pushes",
    "plan": "runs/plan/{task}-{reward}-{objects}-{planner}-{seed}",
    "evaluate": "runs/evaluate/{task}-{reward}-{objects}-{planner}-{seed}",
    "reproduce": "runs/reproduce/{scale}",
    "quickstart": "runs/quickstart/pushes-{minutes}-{seed}",
}
# Options that never decide which folder a run has: runs that differ only in these are the same run.
SAME_RUN = {"output", "workers", "transitions", "sections", "episodes", "video", "video_format", "viewer", "port"}
USER_CLASS = re.compile(r"\+{0,2}(env\.(?:robot|objects|camera|segmentation))\._target_=")
PATHS = ("output", "data", "checkpoint", "pointnet", "initial", "models", "table", "env.assets")
OF_TABLETOP = ("task", "tiles", "layout", "generated", "reward", "criterion", "objects", "maximum_steps", "margin")


def compose(name: str, *overrides: str, **options: Any) -> DictConfig:
    """The configuration of `python -m cavin_pyro.<name> <overrides>`, for callers in Python; see `composed`.

    The same by keyword: compose("plan", task="crossing", env={"camera": "kinect2"}).
    """
    words = [f"{one}={as_typed(value)}" for one, value in flat_options(options).items()]
    return composed(name, [*overrides, *words])[0]


def as_typed(value: Any) -> str:
    """A value as a user types it."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if value is None or isinstance(value, bool | int | float):
        return shown(value) if value is None or isinstance(value, bool) else str(value)
    if not isinstance(value, str | os.PathLike | Number):
        said = f"an option is a name, a number, a list or a section, not an object of {type(value).__name__}"
        raise UserError(f"{said}: fit and rollout take objects")
    plain = re.fullmatch(r"(?!(null|true|false|nan|inf)$)[a-z_][\w./-]*", str(value), re.IGNORECASE)
    return str(value) if plain else QuotedString(str(value), Quote.single).with_quotes()


def composed(name: str, overrides: Sequence[str], config_dir: str | None = None) -> tuple[DictConfig, dict[str, str]]:
    """The configuration of a command, and the choice of each group of presets; `config_dir` has further presets.

    An unknown command, option or preset, an override that does not parse, or a value out of its range is a `UserError`.
    """
    if name not in COMMANDS:
        raise UserError(f"unknown command {name!r}: choose from {', '.join(COMMANDS)}")
    register(name)
    words = [f"hydra.searchpath=['file://{Path(config_dir).resolve()}']"] if config_dir else []
    words += rewritten(overrides, plans=hasattr(COMMANDS[name], "planner"))
    for group, _, choice in (word.partition("=") for word in words if config_dir):
        _check_preset(Path(config_dir or "", group, f"{choice}.yaml"))
    running, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None  # also within a sweep
    try:
        with hydra.initialize(version_base="1.3", config_path=None):
            try:
                return _composed(name, words)
            except Exception as error:
                said = str(error) if isinstance(error, UserError) else _explained(name, words, error)
                own = "env" if any(word.startswith(("env=", "env.")) for word in overrides) else "world"  # as typed
                raise UserError(re.sub(r"\bworld(?=\.)|(?<= under )world\b", own, said)) from error
    finally:
        GlobalHydra.instance().hydra = running


def _check_preset(path: Path) -> None:
    """Raise a `UserError` for a preset of the user's that holds no options."""
    if path.is_file():
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, ValueError) as error:
            raise UserError(f"{path} is not YAML: {one_line(error)}") from error
        if not isinstance(content, dict):
            raise UserError(f"{path} must hold options, NAME: VALUE, with _target_: the class, not {told(content)}")


@functools.cache
def register(name: str) -> None:
    """Tell Hydra a command's options, and its presets with all the options of their classes.

    A preset has `_target_`, the class, and its differences from the class's defaults, so no default is written twice.
    """
    store = ConfigStore.instance()
    store.store(name, COMMANDS[name], provider="cavin_pyro")
    for entry in COMMANDS[name]().defaults:
        group = next(iter(entry)) if isinstance(entry, dict) else ""
        files = (PRESETS / group).rglob("*.yaml") if group else [PRESETS / f"{entry}.yaml"] * (entry != "_self_")
        for file in files:
            text, folder = file.read_text(encoding="utf-8"), file.parent.relative_to(PRESETS).as_posix()
            package = re.match(r"# @package (\S+)", text)
            store.store(
                file.stem,
                with_defaults(yaml.load(text, yaml.CSafeLoader), group),  # safe_load in C
                group=None if folder == "." else folder,
                package=package and package[1],
                provider="cavin_pyro",
            )


def finished(name: str, config: DictConfig, hydra_config: Any, differing: Sequence[str] | None = None) -> DictConfig:
    """What Hydra has composed, resolved, checked and with a folder for results, without Hydra's own section.

    An option without a value, or with one out of its range, is a `UserError`. `differing`: the overrides by which a run
    of a sweep differs from the others, and which name its folder.
    """
    own = copy.deepcopy(config)
    OmegaConf.set_readonly(own, False)
    OmegaConf.set_struct(own, False)
    own.pop("hydra", None)
    OmegaConf.resolve(own)  # checks the types of what interpolations stand for
    # Plain, because Hydra's own interpolations mean nothing in a worker process.
    plain: Any = OmegaConf.to_container(own, throw_on_missing=True)
    check_options(COMMANDS[name], plain)
    for group in (next(iter(entry)) for entry in COMMANDS[name]().defaults if isinstance(entry, dict)):
        if not OmegaConf.select(own, group.replace("/", ".")):
            raise UserError(f"{group} must be one of {', '.join(presets(group))}")
    if differing is not None:
        plain["output"] = os.path.join(hydra_config.sweep.dir, _file_name(differing))
    elif plain["output"] == "":
        raise UserError("output= is empty: name a folder, or leave it out")
    elif plain["output"] is None:
        plain["output"] = _default_output(name, plain, hydra_config)
    return OmegaConf.create(plain)


def presets(group: str) -> list[str]:
    """The choices in a group of presets, such as `planner`; none for a group that is not ours."""
    return sorted(file.stem for file in (PRESETS / group).glob("*.yaml"))


def sweeps(overrides: Sequence[str]) -> Iterator[list[str]]:
    """The overrides of every run of a sweep (`-m`): all combinations of the values given."""
    choices = []
    for one in map(_parsed, overrides):
        values = one.sweep_string_iterator() if one.is_sweep_override() else ()
        choices.append([f"{one.get_key_element()}={value}" for value in values] or [one.input_line or ""])
    yield from map(list, itertools.product(*choices))


def of_sweep(overrides: Sequence[str]) -> tuple[set[str], list[str]]:
    """The options that vary in a sweep, and what Hydra is told about the folder of its runs."""
    parsed = [_parsed(word) for word in overrides]
    folder = [f"hydra.sweep.dir={as_typed(str(one.value()))}" for one in parsed if one.key_or_group == "output"]
    return {one.get_key_element() for one in parsed if one.is_sweep_override()}, folder


def rewritten(overrides: Sequence[str], *, plans: bool = False) -> list[str]:
    """The overrides in Hydra's form.

    `planner.optimizer=cem` becomes `planner/optimizer=cem`, which brings cem's options with it. Parts of the world that
    are ours have a name and no section, which a class of the user's and its arguments need: `env.camera._target_=Mine`
    becomes `env.camera={} ++env.camera._target_=Mine`. Another world is a section of its own: `env=pusht env.ahead=25`
    becomes `world=pusht world.ahead=25`, and `planner=search`, where a command has planners and the user chose none.

    A `UserError`: an unknown world, or an option of the tabletop for another one.
    """
    overrides = _of_other_world(overrides, plans=plans)
    parts = dict.fromkeys(one[1] for word in overrides if (one := USER_CLASS.match(word)))
    words = [f"{part}={{}}" for part in parts]
    for word in overrides:
        key, _, value = word.partition("=")
        group = key.replace(".", "/")
        if key.lstrip("+").startswith(tuple(f"{part}." for part in parts)):
            word = f"++{word.lstrip('+')}"
        elif "." in key and (PRESETS / group).is_dir() and re.fullmatch(r"(?!null$)[A-Za-z_][\w.,]*", value):
            word = f"{group}={value}"
        words.append(_quoted(word))
    return words


def _quoted(word: str) -> str:
    """An override in Hydra's grammar, which lacks letters of some paths: these are put into quotes."""
    key, sign, value = word.partition("=")
    if key in PATHS and not value.startswith("["):
        try:
            OverridesParser.create().parse_override(word)
        except HydraException:
            value = QuotedString(value, Quote.single).with_quotes()
    return key + sign + value


def _of_other_world(overrides: Sequence[str], *, plans: bool) -> list[str]:
    """The overrides with those of `env` as those of `world`, if they choose another world than the tabletop."""
    chosen = next((word for word in overrides if re.match(r"\+{0,2}env(\._target_)?=", word)), "")
    choice = chosen.partition("=")[2]
    if not chosen or choice == "tabletop":
        return [word for word in overrides if word != chosen]
    own = "_target_" in chosen
    if choice in ("", "null") or (not own and choice not in presets("world")):
        raise UserError(f"unknown env {choice!r}: choose from {', '.join(presets('world'))}, or env._target_=CLASS")
    words = [] if own else [f"world={choice}"]
    for word in overrides:
        key, _, value = word.lstrip("+").partition("=")
        if key.partition(".")[0] in OF_TABLETOP:
            raise UserError(f"{key} is an option of env=tabletop: leave it out, or give one of env.* with {chosen}")
        if key in ("env", "env._target_") and word != chosen:
            raise UserError(f"{chosen} and {word}: choose one env")
        if key.startswith("env."):
            word = f"{'++' if own else ''}world.{key.removeprefix('env.')}={value}"
        if word != chosen:
            words.append(word)
    if plans and not any(word.startswith(("planner=", "planner._target_=")) for word in words):
        words.append("planner=search")
    return words


def _composed(name: str, words: Sequence[str]) -> tuple[DictConfig, dict[str, str]]:
    parsed = [*map(_parsed, words)]
    config = hydra.compose(name, overrides=list(words), return_hydra_config=True)
    for one in parsed:
        section = one.key_or_group.rpartition(".")[0]
        if re.match(r"hydra\.(?!(launcher|sweeper|searchpath)\b)", one.key_or_group):
            raise UserError(f"{one.input_line}: Hydra's folders and logs are not used here; choose output=DIR")
        if isinstance(one.value(), list) and one.value() and presets(one.key_or_group):  # Hydra would take the last
            raise UserError(
                f"{one.input_line}: {one.key_or_group} takes one choice, not a list; several values need -m"
            )
        if one.is_delete():
            raise UserError(f"{one.input_line}: an option cannot be removed; give it a value, {one.key_or_group}=value")
        if one.is_add() or one.is_force_add():  # arguments of a part, which its class checks
            part: Any = OmegaConf.select(config, section) if section else None
            known = {option.name for option in options(COMMANDS[name])}
            if one.key_or_group not in known and not (OmegaConf.is_dict(part) and "_target_" in part):
                raise UserError(_unknown(name, one.key_or_group, config))
    choices = {str(group): choice for group, choice in config.hydra.runtime.choices.items()}
    return finished(name, config, config.hydra), choices


def _default_output(name: str, config: dict[str, Any], hydra_config: Any) -> str:
    """A folder that says how a run differs from the usual one: "runs/train-model=flat,guide=flat"."""
    pattern = OUTPUT.get(name, f"runs/{name}")
    world = str((config.get("world") or {}).get("_target_") or "").rpartition(".")[2].lower()
    if world:
        pattern = re.sub(r"pushes|{task}-{reward}-{objects}", world, pattern)
    told = {*SAME_RUN, "world", "world._target_", *re.findall(r"{(\w+)}", pattern)}
    overrides = [word.lstrip("+") for word in hydra_config.overrides.task if not word.endswith("={}")]
    others = _file_name([word for word in overrides if word.partition("=")[0] not in told])
    return pattern.format(**{**config, **hydra_config.runtime.choices}) + ("-" if others else "") + others


def _file_name(overrides: Sequence[str]) -> str:
    """The overrides as a part of a path; of long ones the beginning and a digest, as file systems take 255 bytes."""
    name = ",".join(sorted(word.lstrip("+").replace("/", "-") for word in overrides)).encode()
    if len(name) > 200:
        name = name[:190] + b"-" + hashlib.sha256(name).hexdigest()[:8].encode()
    return name.decode(errors="ignore")


def _explained(name: str, words: Sequence[str], raised: Exception) -> str:
    """One line about the first override with which the composition fails; those that choose presets come first."""
    words = sorted(words, key=lambda word: not ((PRESETS / word.partition("=")[0]).is_dir() or "searchpath" in word))
    known: Any = _composed(name, [])[0]
    for count, word in enumerate(words, start=1):
        try:
            known, _ = _composed(name, words[:count])
        except UserError as error:
            return str(error)
        except Exception as error:
            return _reason(name, word, error, known)
    return one_line(raised)


def _reason(name: str, word: str, error: Exception, known: DictConfig) -> str:
    key = word.partition("=")[0].lstrip("+")
    if isinstance(error, MissingConfigException):
        group, _, choice = (error.missing_cfg_file or "").rpartition("/")
        own = f"; a class of your own is {key.replace('/', '.')}._target_={choice}" if "." in choice else ""
        return f"unknown {group} {choice!r}: choose from {', '.join(error.options or ())}{own}"
    if "/" not in key and not key.startswith("hydra") and OmegaConf.select(known, key, default=error) is error:
        return _unknown(name, key, known)
    first = str(error.__cause__ or error).splitlines()[0]
    if "ListConfig" in first and OmegaConf.is_list(OmegaConf.select(known, key)):
        return f"{word}: {key} must be a list, such as [a,b]"
    if entry := re.fullmatch("Key '(.+)' is not in struct", first):
        return _unknown(name, f"{key}.{entry[1]}", known)
    if first.startswith("Could not override") and "/" in key:
        section, _, part = key.rpartition("/")
        return f"{word}: the chosen {section} has no {part}: leave it out, or choose another {section}"
    if choices := presets(key.replace(".", "/")):
        first += f"; choose from {', '.join(choices)}"
    if first.startswith("Ambiguous value"):
        first += f"; several values need -m: python -m cavin_pyro.{name} -m {word}"
    return f"{word}: {first}"


def _unknown(name: str, key: str, known: DictConfig) -> str:
    """What an option that a command does not have may have meant."""
    section, _, last = key.rpartition(".")
    while section and not OmegaConf.is_dict(OmegaConf.select(known, section)):
        section = section.rpartition(".")[0]
    names = sorted({*map(str, OmegaConf.select(known, section) if section else known)} - {last, "hydra"})
    there = section == key.rpartition(".")[0]
    close = difflib.get_close_matches(last, names, n=1, cutoff=0.7) if there else []
    first = key.partition(".")[0]  # of sections that presets fill
    others = [
        one
        for one, schema in COMMANDS.items()
        if one != name
        and (key in {option.name for option in options(schema)} or (not there and hasattr(schema, first)))
    ]
    return (
        f"unknown option {key!r}: "
        + (f"it is an option of {', '.join(others)}; " if others else "")
        + (f"did you mean {close[0]}? " if close else "")
        + f"valid{' under ' if section else ''}{section} are {', '.join(names)}"
    )


def _parsed(word: str) -> Override:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException as error:
        raise UserError(f"{word}: {str(error).splitlines()[0]}; write name=value, or 'name=\"value\"'") from error
