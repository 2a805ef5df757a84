"""Export to Minari's format, which agents and libraries for offline reinforcement learning read.

Minari is an optional extra, imported here alone.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from cavin_pyro import __version__
from cavin_pyro.config.errors import UserError
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.envs.tabletop.workspace import POINTS_PER_OBJECT
from cavin_pyro.storage.files import output_folder
from cavin_pyro.storage.progress import progress_bar

OBSERVED = ("centers", "clouds", "visible")  # of every state; `mask` is the same in all states of an episode
TOLD = ("moved", "unsafe", "ineffective", "fallen", "target", "angle")  # of every push, as `infos`
OBJECTS = ("shape", "scale", "mass", "friction")  # of an episode, among its `options`
DESCRIPTION = (
    "Random pushes of objects on a table by a heuristic policy. An observation has the objects' centres in metres, "
    "their clouds in metres from the centre, whether the camera saw them, and which of the slots hold an object. An "
    "action is a normalised push. No task is pursued, so every reward is 0."
)


def export(folder: Path, target: Path) -> int:
    """Write a dataset as `target/data`, where `minari.load_dataset` finds it with `target`'s parent as its root.

    Minari's `recover_environment` makes its world, of which a line says so if it cannot. Returns how many episodes were
    written. Raises UserError: Minari is not installed, a name that it does not take, no dataset, a corrupt shard,
    `target` holds a dataset, or the disk refused.
    """
    try:
        import minari
        from minari.dataset.minari_storage import MinariStorage
    except ImportError as error:
        raise UserError(f"export needs Minari ({error}): pip install -c constraints.txt -e '.[minari]'") from error
    if not re.fullmatch(r"[\w-]+-v\d+", target.resolve().name):
        raise UserError(f"--to {target} must end in a name and a version, as Minari wants: --to {target}-v0")
    metadata = dataset.read_metadata(folder)
    dataset.check_tabletop([folder], "export writes those of the tabletop")
    with output_folder(target):
        written, partial = target / "data", target / ".data.partial"
        if written.exists():
            raise UserError(f"{target} holds a dataset already: choose another folder with --to DIR")
        shutil.rmtree(partial, ignore_errors=True)  # of a killed run
        try:
            storage = MinariStorage.new(
                partial.resolve(),  # because Minari takes the size of what it has written from a relative path twice
                observation_space=observation_space(dataset.slots_of(metadata)),
                action_space=spaces.Box(-1.0, 1.0, (4,), np.float32),
                env_spec=environment_of(metadata),
                data_format="hdf5",
            )
            storage.update_metadata(
                {
                    "dataset_id": target.resolve().name,
                    "minari_version": minari.__version__,
                    "algorithm_name": "heuristic pushing policy",
                    "description": DESCRIPTION,
                    "cavin_pyro": {**metadata, "exported_by": f"cavin_pyro {__version__}"},
                }
            )
            storage.update_episodes(_episodes(folder))
            partial.rename(written)
        except (OSError, RuntimeError) as error:  # HDF5 raises both on a full disk
            raise UserError(f"{target} could not be written ({str(error).splitlines()[0]})") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return int(metadata["episodes"])


def observation_space(slots: int) -> spaces.Dict:
    """What an observation is, M = `slots` objects and P points each."""
    infinite, flags = np.inf, spaces.MultiBinary(slots)
    centers = spaces.Box(-infinite, infinite, (slots, 3), np.float32)
    clouds = spaces.Box(-infinite, infinite, (slots, POINTS_PER_OBJECT, 3), np.float16)
    return spaces.Dict({"centers": centers, "clouds": clouds, "visible": flags, "mask": flags})


def environment_of(metadata: Mapping[str, Any]) -> EnvSpec | None:
    """The environment with a dataset's world, in the task crossing; None, with a line, for parts of the user's own."""
    made = metadata["configuration"]
    for name in ("object_set", "camera", "segmentation"):
        if not isinstance(made.get(name), str):
            print(f"recover_environment() will not work: {name}={made.get(name)} has no name in this program")
            return None
    return EnvSpec(
        id="cavin/Pushing-v0",
        entry_point="cavin_pyro.envs.tabletop.pushing:PushingEnv",  # which Gymnasium imports, so that nobody needs to
        kwargs={
            "objects": made.get("maximum_objects", dataset.slots_of(metadata)),
            "maximum_steps": made["steps"],
            **{name: made.get(name) for name in ("ranges", "object_set", "camera", "segmentation")},
        },
    )


def _episodes(folder: Path) -> Iterator[Any]:
    """The episodes of a dataset without their padding, a shard in memory at a time."""
    from minari.data_collector import EpisodeBuffer

    metadata = dataset.read_metadata(folder)
    seed = dataset.seed_of(metadata)
    with progress_bar("exporting", total=metadata["episodes"], unit="episode") as bar:
        for _, shard in dataset.iterate_shards(folder, tuple(dataset.ARRAYS)):
            arrays = dataset.padded(shard, dataset.slots_of(metadata))
            for index in range(len(arrays["length"])):
                options = {"root_seed": seed, "episode": int(arrays["episode"][index])}
                options |= {name: arrays[name][index] for name in OBJECTS}
                yield EpisodeBuffer(options=options, **_episode({name: one[index] for name, one in arrays.items()}))
                bar.update()


def _episode(arrays: Arrays) -> dict[str, Any]:
    pushes = int(arrays["length"])
    ended = np.arange(pushes) == pushes - 1
    fallen = arrays["fallen"][:pushes]
    observations = {name: arrays[name][: pushes + 1] for name in OBSERVED}
    observations |= {"visible": observations["visible"].astype(np.int8)}
    observations |= {"mask": np.repeat(arrays["mask"][None].astype(np.int8), pushes + 1, axis=0)}
    return {
        "observations": observations,
        "actions": arrays["actions"][:pushes],
        "rewards": np.zeros(pushes),
        "terminations": fallen,
        "truncations": ended & ~fallen,
        "infos": {name: arrays[name][:pushes] for name in TOLD},
    }
