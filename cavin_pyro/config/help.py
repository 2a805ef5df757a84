"""`--help`: what a command does, examples, and every option with its meaning, unit, default and choices."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from importlib import resources
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.commands import COMMANDS, UNREAD
from cavin_pyro.config.options import options, shown

WIDTH = 100  # columns
EXAMPLES = {
    "collect": ("transitions=100000 workers=2", "env.objects=random output=data/random", "transitions=200000"),
    "pretrain": ("data=data/pushes", "data=[data/pushes,data/random]", "held_out_objects=[mug,banana]"),
    "train": ("data=data/pushes", "model=flat guide=flat", "trainer.steps=200000 trainer.batches=bucketed"),
    "check": (
        "checkpoint=cavin data=data/pushes",
        "a=cavin b=sectar",
        "sections=[prior,consistency] sizes.consistency.scenes=300",
    ),
    "calibrate": (
        "checkpoint=runs/train/checkpoint.safetensors data=data/pushes",
        "checkpoint=cavin wake_weight=0",
        "checkpoint=contact steps=3000 seed=1",
    ),
    "plan": ("task=insertion objects=5 seed=3", "planner=paper", "planner.optimizer=cem env.segmentation=clusters"),
    "evaluate": (
        "task=crossing reward=sparse objects=3",
        "planner=paper compare=runs/evaluate/crossing-sparse-3-cavin-0",
        "-m task=clearing,insertion,crossing episodes=50",
    ),
    "demo": ("", "tasks=[gathering] objects=5", "env.segmentation=clusters"),
    "reproduce": ("scale=smoke", "scale=medium planners=[paper]", "scale=paper shard=2/3"),
}
HEADINGS = {  # of the groups, in the order of the page
    "task": "Task",
    "planning": "Planning",
    "model": "Model",
    "data": "Data",
    "policy": "Policy",
    "training": "Training",
    "trainer": "Trainer",
    "windows": "Training windows",
    "world": "World",
    "objects": "Objects",
    "run": "Run",
}
FACTS_OF_PRESETS = ("model_free", "default_checkpoint")  # which a preset tells the program, and users need not set
# "name: what it means" or "one, other: what both mean", up to the next of its kind; names may be in backticks.
NAMES = r"`?[a-z_]+`?(?:, `?[a-z_]+`?)*"
MEANING = rf"(?:(?<=\s)|^)({NAMES}): (.+?)(?=\s{NAMES}: |\n\n|$)"
FLAGS = """
-m                       one run for each value: -m seed=0,1,2 (Hydra's launchers: hydra/launcher=...)
--cfg job                print the configuration, run nothing
--config-dir DIR         a folder of presets of your own
--version                print the version
"""


def help_page(name: str, purpose: str, config: DictConfig) -> str:
    """The page of a command.

    Args:
        purpose: its docstring. config: as composed with Hydra's own, so that the options of chosen presets are shown.
    """
    unread = UNREAD.get(name, ())
    lines = [f"python -m cavin_pyro.{name} [option=value ...]     (cavin_pyro {__version__})", ""]
    lines += textwrap.wrap(" ".join(inspect.cleandoc(purpose).split()), WIDTH)
    lines += ["", "Examples"]
    lines += [f"  python -m cavin_pyro.{name} {overrides}".rstrip() for overrides in EXAMPLES[name]]
    chosen = {str(group): str(choice) for group, choice in config.hydra.runtime.choices.items()}
    own = {group: choice for group, choice in chosen.items() if presets(group) and group not in unread}
    if own:
        lines += ["", "Presets: each sets several options, which are listed below"]
    for group, choice in own.items():
        lines += _entry(f"{group}={choice}", f"one of {', '.join(presets(group))}")
    declared = [one for one in options(COMMANDS[name]) if one.name.partition(".")[0] not in unread]
    for group, heading in HEADINGS.items():
        grouped = [one for one in declared if one.about.group == group]
        if grouped:
            lines += ["", heading]
        for one in grouped:
            unit = f", in {one.about.unit}" if one.about.unit else ""
            choices = f"; one of {', '.join(one.about.names)}" if one.about.names else ""
            value = OmegaConf.select(config, one.name)
            lines += _entry(f"{one.name}={_text(value)}", f"{one.about.help}{unit}{choices}")
    for group in own:
        section: Any = OmegaConf.select(config, group.replace("/", "."))
        if OmegaConf.is_dict(section) and "." not in group and "/" not in group:
            entries = list(_part_entries(group, OmegaConf.to_container(section)))
            if entries:
                lines += ["", f"{group.capitalize()}, for {group}={chosen[group]}"]
            for entry in entries:
                lines += _entry(*entry)
    lines += ["", "Flags"]
    for flag in FLAGS.strip().splitlines():
        lines += _entry(*(part.strip() for part in re.split(r"  +", flag, maxsplit=1)))
    return "\n".join(lines)


def presets(group: str) -> list[str]:
    """The choices in a group of presets, such as `planner`; none for a group that is not ours."""
    folder = resources.files("cavin_pyro.config.presets").joinpath(group)
    if group.startswith("hydra") or not folder.is_dir():
        return []
    return sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))


def _part_entries(prefix: str, section: Any, meaning: str = "") -> Iterator[tuple[str, str]]:
    """The options of a part and of the parts in it, with what its class says of each.

    Args:
        meaning: of the section, for the entries of one without a class.
    """
    found = _found(section.get("_target_"))
    meanings, kind = _meanings(found), "function" if inspect.isfunction(found) else "class"
    for name, value in section.items():
        said = meanings.get(name, meaning)
        if isinstance(value, dict):
            yield from _part_entries(f"{prefix}.{name}", value, said)
        elif name == "_target_":
            default = f"null takes that of {prefix.rpartition('.')[2]}=; " if value is None else ""
            yield f"{prefix}._target_={_text(value)}", f"the {kind}; {default}name one of your own to take its place"
        elif name not in FACTS_OF_PRESETS and not name.startswith("_"):  # such as Hydra's _partial_
            yield f"{prefix}.{name}={_text(value)}", said


def _found(target: str | None) -> Any:
    """The class or function at a dotted path, None if there is none."""
    try:
        return target and get_object(target)
    except Exception:  # a user's module may raise anything; building the part says it in one line
        return None


def _meanings(found: Any) -> Mapping[str, str]:
    """What the docstrings of a class, its parents and their constructors, or of a function, say of each argument.

    Returns:
        A sentence by the argument's name.
    """
    meanings: dict[str, str] = {}
    for text in map(inspect.cleandoc, _docstrings(found)):
        for names, said in re.findall(MEANING, text, re.S):
            sentence = re.split(r"(?<=[^.])\.(?:\s|$)", " ".join(said.split()))[0]
            sentence = re.sub(r"\bNone\b", "null", sentence)  # as the command line writes it
            for name in names.replace("`", "").split(", "):
                meanings.setdefault(name, sentence)
    return meanings


def _docstrings(found: Any) -> list[str]:
    """Those of a function, or of a class and each of its parents with their constructors."""
    described = [found]
    if inspect.isclass(found):
        described = [part for one in found.__mro__ for part in (one, vars(one).get("__init__")) if part is not None]
    return [one.__doc__ for one in described if one.__doc__]


def _text(value: Any) -> str:
    if OmegaConf.is_list(value) or isinstance(value, list):
        return f"[{','.join(str(_text(entry)) for entry in value)}]"
    return str(shown(value))


def _entry(option: str, help: str) -> list[str]:
    indent = 34
    wrapped = textwrap.wrap(help, WIDTH - indent) or [""]
    first = f"  {option}"
    if len(first) >= indent:
        return [first, *(" " * indent + line for line in wrapped if line)]
    return [f"{first:<{indent}}{wrapped[0]}".rstrip(), *(" " * indent + line for line in wrapped[1:])]
