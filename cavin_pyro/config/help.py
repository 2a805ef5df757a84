"""`--help`: what a command does, examples, and every option with its meaning, unit, default and choices."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.composition import presets
from cavin_pyro.config.options import options, shown

WIDTH, INDENT = 100, 34  # columns
EXAMPLES = {
    "quickstart": ("minutes=10", "env=pusht", "env._target_=my.World output=runs/mine"),
    "collect": ("transitions=100000 workers=2", "env.objects=random output=data/random", "transitions=200000"),
    "pretrain": ("data=data/pushes", "data=[data/pushes,data/random]", "held_out_objects=[mug,banana]"),
    "train": ("data=data/pushes", "model=flat guide=flat", "trainer.steps=200000 trainer.batches=bucketed"),
    "check": ("checkpoint=cavin data=data/pushes", "checkpoint=contact windows=2000", "sections=[prior,subgoals]"),
    "plan": (
        "task=insertion objects=5 seed=3",
        "-m planner=cavin,paper",
        "planner.optimizer=cem env.segmentation=clusters",
    ),
    "imagine": ("checkpoint=contact seed=1", "checkpoint=cavin task=clearing", "env=pusht checkpoint=pusht"),
    "evaluate": ("task=crossing objects=3", "planner=paper", "-m task=clearing,insertion,crossing"),
    "reproduce": ("scale=smoke", "scale=medium planners=[paper]", "scale=paper shard=2/3"),
}
# --help lists the options that a user of the field changes, --help=all every one: those without a section, but
RARE = {
    *("world", "env/ranges", "criterion", "push_decimals", "matmul_precision", "trust"),
    *("intent_length", "perturbation_rate", "episodes_per_shard", "autoencoder", "first_scene"),
}
USUAL = {  # and of sections
    *("planner.samples", "planner.horizon", "planner.add", "planner.compile"),
    *("env.objects", "env.camera", "env.segmentation", "env.assets"),
    *("model.width", "model.effect_dimension", "model.motion_dimension", "objective.elbo.num_particles"),
    *("trainer.steps", "trainer.batch_size", "trainer.learning_rate", "trainer.schedule", "trainer.validate_every"),
    *("trainer.patience", "windows.held_out_objects", "autoencoder.width", "autoencoder.feature_dimension"),
    *("sizes.guide.samples", "sizes.predictive.replicates", "sizes.subgoals.scenes"),
}
FACTS_OF_PRESETS = ("model_free", "default_checkpoint")  # which a preset tells the program, and users need not set
FLAGS = {
    "-m": "one run for each value: -m seed=0,1,2 (Hydra's launchers: hydra/launcher=...)",
    "--cfg job": "print the configuration, run nothing",
    "--config-dir DIR": "a folder of presets of your own",
    "--traceback": "show where an error comes from",
    "--version": "print the version",
}


def help_page(
    name: str, purpose: str, config: DictConfig, choices: Mapping[str, str], *, everything: bool = True
) -> str:
    """The page of a command: its docstring, and its options as composed, with those of the preset of each group.

    `everything`: all options, by the part that reads them, instead of the usual ones.
    """
    lines = [f"python -m cavin_pyro.{name} [option=value ...]     (cavin_pyro {__version__})", ""]
    lines += textwrap.wrap(" ".join(inspect.cleandoc(purpose).split()), WIDTH)
    lines += ["", "Examples"]
    lines += [f"  python -m cavin_pyro.{name} {overrides}".rstrip() for overrides in EXAMPLES[name]]
    hidden = 0
    for section, entries in option_entries(name, config, choices).items():
        listed = [one for one in entries if everything or is_usual(one[0].partition("=")[0])]
        lines += ["", section] * bool(listed) + [line for one in listed for line in _entry(*one)]
        hidden += len(entries) - len(listed)
    lines += ["", "Flags"]
    flags = {f"--help{'=all' if hidden else ''}": f"list {hidden or 'all'} {'more ' * bool(hidden)}options"} | FLAGS
    return "\n".join([*lines, *(line for one in flags.items() for line in _entry(*one))])


def is_usual(option: str) -> bool:
    """Whether --help lists an option."""
    return option in USUAL or ("." not in option and option not in RARE)


def option_entries(name: str, config: DictConfig, choices: Mapping[str, str]) -> dict[str, list[tuple[str, str]]]:
    """Every option of a command as `name=value`, with its meaning, by the heading of the part that reads it."""
    own = {group: choice for group, choice in choices.items() if presets(group)}
    groups = [(f"{group}={choice}", f"one of {', '.join(presets(group))}") for group, choice in own.items()]
    entries = {"Presets: each sets several options": groups}
    for one in options(COMMANDS[name]):
        section = one.name.rpartition(".")[0]
        unit = f", in {one.about.unit}" if one.about.unit else ""
        names = f"; one of {', '.join(one.about.names)}" if one.about.names else ""
        option = f"{one.name}={shown(OmegaConf.select(config, one.name))}"
        heading = f"Options of {section}" if section else "Options"
        entries.setdefault(heading, []).append((option, f"{one.about.help}{unit}{names}"))
    for group in own:
        part: Any = OmegaConf.select(config, group)
        if OmegaConf.is_dict(part):
            heading = f"{group.capitalize()}, for {group}={choices[group]}"
            entries[heading] = [*_part_entries(group, OmegaConf.to_container(part))]
    return entries


def _part_entries(prefix: str, section: Any, meaning: str = "") -> Iterator[tuple[str, str]]:
    """The options of a part and of the parts in it, with what its class says of each; without one, the meaning."""
    try:
        found = section.get("_target_") and get_object(section["_target_"])
    except (Exception, SystemExit):  # a user's module may raise anything; building the part says it in one line
        found = None
    meanings, kind = _meanings(found, section), "function" if inspect.isfunction(found) else "class"
    for name, value in section.items():
        said = meanings.get(name, meaning)
        if isinstance(value, dict):
            yield from _part_entries(f"{prefix}.{name}", value, said)
        elif name == "_target_":
            default = f"null takes that of {prefix.rpartition('.')[2]}=; " if value is None else ""
            yield f"{prefix}._target_={shown(value)}", f"the {kind}; {default}name one of your own to take its place"
        elif name not in FACTS_OF_PRESETS and not name.startswith("_"):  # such as Hydra's _partial_
            yield f"{prefix}.{name}={shown(value)}", said


def _meanings(found: Any, section: Mapping[str, Any]) -> Mapping[str, str]:
    """The sentences on each argument in the docstrings of a class, its parents, their constructors, or a function.

    "name: what it means" or "one, other: what both mean", up to the next; names may be in backticks.
    """
    described, known = [found], {*section}
    if inspect.isclass(found):
        described = [part for one in found.__mro__ for part in (one, vars(one).get("__init__"))]
    for one in described:
        with suppress(TypeError, ValueError):  # None, or a class written in C
            known.update(inspect.signature(one).parameters)
    name = rf"`?(?:{'|'.join(sorted(known))})`?"
    names_of = rf"{name}(?:, {name})*"
    entry = rf"(?:(?<=\s)|^)({names_of}): (.+?)(?=\s{names_of}: |\n\n|$)"
    meanings: dict[str, str] = {}
    for text in (inspect.cleandoc(one.__doc__) for one in described if one is not None and one.__doc__):
        for names, said in re.findall(entry, text, re.S):
            sentence = re.split(r"(?<=[^.])\.(?:\s|$)", " ".join(said.split()))[0]
            sentence = re.sub(r"(:\w+:)?`~?([^`]*)`", r"\2", sentence)
            sentence = re.sub(r"\bNone\b", "null", sentence)  # as the command line writes it
            for name in names.replace("`", "").split(", "):
                meanings.setdefault(name, sentence)
    return meanings


def _entry(option: str, meaning: str) -> list[str]:
    *long, option = re.findall(rf".{{1,{WIDTH - 4}}}(?:,|$)", option) if len(option) > WIDTH - 4 else [option]
    first, rest = f"  {option}".ljust(INDENT - 1) + " ", " " * INDENT
    told = textwrap.wrap(meaning, WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False)
    return [*(f"  {part}" for part in long), *(told or [f"  {option}"])]
