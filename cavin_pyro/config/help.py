"""`--help`: what a command does, examples, and every option with its meaning, unit, default and choices."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.composition import PRESETS
from cavin_pyro.config.options import Option, options, shown

WIDTH, INDENT = 100, 34  # columns
EXAMPLES = {
    "collect": ("transitions=100000 workers=2", "env.objects=random output=data/random", "transitions=200000"),
    "pretrain": ("data=data/pushes", "data=[data/pushes,data/random]", "held_out_objects=[mug,banana]"),
    "train": ("data=data/pushes", "model=flat guide=flat", "trainer.steps=200000 trainer.batches=bucketed"),
    "check": ("checkpoint=cavin data=data/pushes", "a=cavin b=sectar", "sections=[prior,subgoals]"),
    "calibrate": ("checkpoint=runs/train/checkpoint.safetensors data=data/pushes", "checkpoint=contact seed=1"),
    "plan": ("task=insertion objects=5 seed=3", "planner=paper", "planner.optimizer=cem env.segmentation=clusters"),
    "evaluate": ("task=crossing objects=3", "planner=paper compare=runs/mine", "-m task=clearing,insertion,crossing"),
    "demo": ("", "tasks=[gathering] objects=5", "env.segmentation=clusters"),
    "reproduce": ("scale=smoke", "scale=medium planners=[paper]", "scale=paper shard=2/3"),
}
FACTS_OF_PRESETS = ("model_free", "default_checkpoint")  # which a preset tells the program, and users need not set
# "name: what it means" or "one, other: what both mean", up to the next of its kind; names may be in backticks.
NAMES = r"`?[a-z_]+`?(?:, `?[a-z_]+`?)*"
MEANING = rf"(?:(?<=\s)|^)({NAMES}): (.+?)(?=\s{NAMES}: |\n\n|$)"
FLAGS = {
    "-m": "one run for each value: -m seed=0,1,2 (Hydra's launchers: hydra/launcher=...)",
    "--cfg job": "print the configuration, run nothing",
    "--config-dir DIR": "a folder of presets of your own",
    "--traceback": "show where an error comes from",
    "--version": "print the version",
}


def help_page(name: str, purpose: str, config: DictConfig, choices: Mapping[str, str]) -> str:
    """The page of a command: its docstring, and its options as composed, with those of the preset of each group."""
    lines = [f"python -m cavin_pyro.{name} [option=value ...]     (cavin_pyro {__version__})", ""]
    lines += textwrap.wrap(" ".join(inspect.cleandoc(purpose).split()), WIDTH)
    lines += ["", "Examples"]
    lines += [f"  python -m cavin_pyro.{name} {overrides}".rstrip() for overrides in EXAMPLES[name]]
    own = {group: choice for group, choice in choices.items() if presets(group)}
    if own:
        lines += ["", "Presets: each sets several options, which are listed below"]
    for group, choice in own.items():
        lines += _entry(f"{group}={choice}", f"one of {', '.join(presets(group))}")
    sections: dict[str, list[Option]] = {}
    for one in options(COMMANDS[name]):
        sections.setdefault(one.name.rpartition(".")[0], []).append(one)
    for section, declared in sections.items():
        lines += ["", f"Options of {section}" if section else "Options"]
        for one in declared:
            unit = f", in {one.about.unit}" if one.about.unit else ""
            names = f"; one of {', '.join(one.about.names)}" if one.about.names else ""
            lines += _entry(f"{one.name}={_text(OmegaConf.select(config, one.name))}", f"{one.about.help}{unit}{names}")
    for group in own:
        part: Any = OmegaConf.select(config, group)
        if OmegaConf.is_dict(part):
            lines += ["", f"{group.capitalize()}, for {group}={choices[group]}"]
            for entry in _part_entries(group, OmegaConf.to_container(part)):
                lines += _entry(*entry)
    lines += ["", "Flags"]
    for flag, meaning in FLAGS.items():
        lines += _entry(flag, meaning)
    return "\n".join(lines)


def presets(group: str) -> list[str]:
    """The choices in a group of presets, such as `planner`; none for a group that is not ours."""
    return sorted(file.stem for file in (PRESETS / group).glob("*.yaml"))


def _part_entries(prefix: str, section: Any, meaning: str = "") -> Iterator[tuple[str, str]]:
    """The options of a part and of the parts in it, with what its class says of each; without one, the meaning."""
    try:
        found = section.get("_target_") and get_object(section["_target_"])
    except Exception:  # a user's module may raise anything; building the part says it in one line
        found = None
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


def _meanings(found: Any) -> Mapping[str, str]:
    """The sentences on each argument in the docstrings of a class, its parents, their constructors, or a function."""
    described = [found]
    if inspect.isclass(found):
        described = [part for one in found.__mro__ for part in (one, vars(one).get("__init__"))]
    meanings: dict[str, str] = {}
    for text in (inspect.cleandoc(one.__doc__) for one in described if one is not None and one.__doc__):
        for names, said in re.findall(MEANING, text, re.S):
            sentence = re.split(r"(?<=[^.])\.(?:\s|$)", " ".join(said.split()))[0]
            sentence = re.sub(r"\bNone\b", "null", sentence)  # as the command line writes it
            for name in names.replace("`", "").split(", "):
                meanings.setdefault(name, sentence)
    return meanings


def _text(value: Any) -> str:
    if OmegaConf.is_list(value) or isinstance(value, list):
        return f"[{','.join(_text(entry) for entry in value)}]"
    return str(shown(value))


def _entry(option: str, meaning: str) -> list[str]:
    return textwrap.wrap(
        meaning,
        WIDTH,
        initial_indent=f"  {option}".ljust(INDENT - 1) + " ",
        subsequent_indent=" " * INDENT,
        break_long_words=False,
    ) or [f"  {option}"]
