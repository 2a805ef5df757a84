"""Overrides as users type them, in the form that Hydra composes."""

from __future__ import annotations

import re
from collections.abc import Sequence

_OWN_CLASS = re.compile(r"\+{0,2}(env\.(?:robot|objects|camera|segmentation))\._target_=.*", re.DOTALL)


def rewritten(overrides: Sequence[str]) -> list[str]:
    """The overrides with names of presets and classes of the user's own in Hydra's form."""
    return sections_of_classes(presets_by_name(overrides))


def presets_by_name(overrides: Sequence[str]) -> list[str]:
    """`planner.optimizer=cem` as `planner/optimizer=cem`, which brings the options of `cem` with it."""
    named = r"^planner\.optimizer=(?!null$)(?=[A-Za-z_][\w.,]*$)"
    return [re.sub(named, "planner/optimizer=", word) for word in overrides]


def sections_of_classes(overrides: Sequence[str]) -> list[str]:
    """`env.camera._target_=my_lab.Mine +env.camera.noise=1` as `env.camera={_target_: my_lab.Mine, noise: 1}`.

    Parts of the world that are ours have a name and no section, which a class of the user's and its arguments need.
    Classes with commas between them are a sweep.
    """
    words = list(overrides)
    for part in dict.fromkeys(one[1] for word in overrides if (one := _OWN_CLASS.fullmatch(word))):
        option = re.compile(rf"\+{{0,2}}{re.escape(part)}\.([\w.]+)=(.*)", re.DOTALL)
        of_part = {place: one for place, word in enumerate(words) if (one := option.fullmatch(word))}
        values = {one[1]: one[2] for one in of_part.values()}
        sections = (
            ", ".join(f"{name}: {value}" for name, value in {**values, "_target_": target}.items())
            for target in values["_target_"].split(",")
        )
        first, *others = of_part
        words[first] = f"{part}=" + ",".join(f"{{{section}}}" for section in sections)
        words = [word for place, word in enumerate(words) if place not in others]
    return words
