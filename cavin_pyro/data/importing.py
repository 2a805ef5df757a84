"""Import of Minari's datasets, whose observations a world reads as its states.

Minari is an optional extra, imported here and for the export alone.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError, one_line, user_input
from cavin_pyro.config.world import world_of
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.data.episodes import described, of_states, packed
from cavin_pyro.storage.files import file_digest, output_folder
from cavin_pyro.storage.progress import progress_bar

EPISODES = 50  # of a file


def import_minari(name: str, target: Path, env: Sequence[str]) -> dict[str, Any]:
    """Write the dataset `minari:NAME` of this machine as one of this program, after all of it was checked.

    `env`: the world as in the option `env`, by a name of ours or its class, and options: ["my.World", "size=3"].

    Returns the metadata of the new dataset, with Minari's name and a SHA-256 of what was read. Raises UserError: Minari
    is not installed, it has no such dataset, a world that cannot be built or that cannot read an observation, actions
    out of its box, numbers that are not finite, or `target` holds a dataset.
    """
    try:
        import minari
    except ImportError as error:
        raise UserError(f"import needs Minari ({error}): pip install -c constraints.txt -e '.[minari]'") from error
    chosen = re.sub(r"^(env\.)?_target_=|^env=", "", env[0])
    named = f"env{'._target_' if '.' in chosen else ''}={chosen}"
    config = compose("collect", named, *(f"env.{option}" for option in env[1:]))
    world, section = world_of(config), OmegaConf.to_container(config.world)
    if world is None or not isinstance(section, dict):
        raise UserError("--env tabletop: episodes of the tabletop have clouds, which no other dataset has")
    identity, episodes = name.removeprefix("minari:"), []
    try:
        source = minari.load_dataset(identity)
        with progress_bar("importing", total=int(source.total_episodes), unit="episode") as bar:
            for number, one in enumerate(source.iterate_episodes()):
                with user_input(where=f"episode {number} of minari:{identity}"):
                    states = [world.state(_at(one.observations, step)) for step in range(len(one) + 1)]
                    episodes.append(of_states(world, states, one.actions))
                bar.update()
    except UserError:
        raise
    except Exception as error:  # whatever Minari and HDF5 raise for files that are missing or damaged
        raise UserError(f"no whole minari:{identity} here ({one_line(error)}): minari download {identity}") from error
    steps = max((len(one["actions"]) for one in episodes), default=0)
    if not 1 <= steps <= dataset.LARGEST["S"]:
        raise UserError(f"minari:{identity} has episodes of up to {steps} steps: from 1 to {dataset.LARGEST['S']} fit")
    home = Path(source.storage.data_path)
    files = sorted(path for path in home.rglob("*") if path.is_file())
    told = "".join(f"{path.relative_to(home)} {file_digest(path)}\n" for path in files)
    digest = hashlib.sha256(told.encode()).hexdigest()
    metadata = {
        "configuration": {**described(world, section), "steps": steps, "minari": identity, "sha256": digest},
        "made_by": f"cavin_pyro {__version__}",
        "shards": -(-len(episodes) // EPISODES),
        "episodes": len(episodes),
        "transitions": sum(len(one["actions"]) for one in episodes),
    }
    _write(target, episodes, steps, metadata)
    return metadata


def _write(target: Path, episodes: Sequence[Arrays], steps: int, metadata: dict[str, Any]) -> None:
    """The metadata come last, so that a killed import leaves no dataset."""
    with output_folder(target, "a dataset") as folder:
        if (folder / "metadata.json").exists():
            raise UserError(f"{target} holds a dataset already: choose another folder with --to DIR")
        for number, first in enumerate(range(0, len(episodes), EPISODES)):
            some = episodes[first : first + EPISODES]
            dataset.write_shard(
                dataset.shard_path(folder, number), packed(some, range(first, first + len(some)), steps)
            )
        dataset.write_metadata(folder, metadata)


def _at(observations: Any, step: int) -> Any:
    """The observation of a step, in whatever spaces they are."""
    if isinstance(observations, dict):
        return {name: _at(part, step) for name, part in observations.items()}
    if isinstance(observations, tuple):
        return tuple(_at(part, step) for part in observations)
    return observations[step]
