"""Ship checkpoints out of a reproduction: `python -m cavin_pyro.storage.shipping RUN_FOLDER [METHOD ...]`.

With `--models` instead of methods: all of its trainings, for `reproduce models=checkpoints/reproduction`.
`python -m cavin_pyro.storage.shipping --calibrated FILE NAME`: the shipped checkpoint NAME as `calibrate` has written
it to FILE.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from cavin_pyro.config.commands.episodes import CHECKPOINTS
from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.checkpoint import Checkpoint, checkpoint_bytes, load_checkpoint, shipped_folder
from cavin_pyro.storage.digests import update_manifest
from cavin_pyro.storage.files import atomic_write, file_digest, read_json, write_json

BASELINES = ("sectar", "cvae_mpc", "mpc")
PARTS = ("model", "guide", "pointnet", "geometry")
PRETRAINED = re.compile(r"output=(.+)/pretrain\b")
SCALES = "model.dynamics.head.bias"  # of `dynamics=contact`, whose last number is the logarithm of the scale
PUBLIC_HOME = "runs/reproduce"  # in shipped files, instead of the folder of the machine that trained


def ship(home: Path, method: str, to: Path) -> dict[str, Any]:
    """Copy the training with the lowest validation loss to `to/METHOD.safetensors`, and its facts beside it as JSON.

    Args:
        home: the folder of a reproduction, with `train/METHOD-SEED`.

    Returns:
        The facts, for the model card.

    Raises:
        UserError: there is no training of the method, or one has not finished.
    """
    if method not in CHECKPOINTS:
        raise UserError(f"unknown method {method!r}: choose from {', '.join(CHECKPOINTS)}")
    folders = _trainings(home, method)
    trained = {folder: load_checkpoint(folder / "checkpoint.safetensors") for folder in folders}
    best = min(folders, key=lambda folder: _loss(trained[folder]))
    chosen = trained[best]
    to.mkdir(parents=True, exist_ok=True)
    _write(to / f"{method}.safetensors", chosen)
    found = facts(chosen, steps=read_json(best / "metrics.json")["steps"])
    found["validation_losses"] = {str(one.config["seed"]): _loss(one) for one in trained.values()}
    write_json(to / f"{method}.json", found)
    return found


def ship_models(home: Path, to: Path) -> list[Path]:
    """Copy every training of a reproduction to `to/METHOD-SEED.safetensors`; returns the paths.

    Raises:
        UserError: as `ship`.
    """
    to.mkdir(parents=True, exist_ok=True)
    shipped = []
    for folder in _trainings(home, ""):
        shipped.append(to / f"{folder.name}.safetensors")
        _write(shipped[-1], load_checkpoint(folder / "checkpoint.safetensors"))
    return shipped


def ship_calibrated(calibrated: Path, shipped: Path) -> None:
    """Replace a shipped checkpoint by the result of its calibration, which differs in what was calibrated alone.

    Raises:
        UserError: it was not calibrated from this file, or something else than the guide or f's scales differs.
    """
    before, after = load_checkpoint(shipped), load_checkpoint(calibrated)
    records = after.provenance.get("calibrated")
    if not isinstance(records, list) or records[-1].get("checkpoint") != file_digest(shipped):
        raise UserError(f"{calibrated} is no calibration of {shipped}: run calibrate checkpoint={shipped}")
    changed = {
        name
        for name in before.tensors.keys() | after.tensors.keys()
        if name not in before.tensors
        or name not in after.tensors
        or not torch.equal(before.tensors[name], after.tensors[name])
    }
    parts = records[-1].get("parts", ["guide"])
    allowed = {name for name in changed if name.startswith("guide.") and "guide" in parts}
    if "scales" in parts and SCALES in changed and before.tensors[SCALES][:-1].equal(after.tensors[SCALES][:-1]):
        allowed.add(SCALES)
    if other := sorted(changed - allowed):
        raise UserError(f"{calibrated} differs from {shipped} in {other[0]}, which was not calibrated")
    if after.config != before.config:
        raise UserError(f"{calibrated} has another configuration than {shipped}")
    _write(shipped, after)


def _trainings(home: Path, method: str) -> list[Path]:
    folders = sorted((home / "train").glob(f"{method}-*" if method else "*-*"))
    if not folders:
        raise UserError(f"{home} holds no training of {method or 'any method'} (train/{method or 'METHOD'}-SEED)")
    if unfinished := [folder for folder in folders if not (folder / "metrics.json").exists()]:
        raise UserError(f"{unfinished[0]} has not finished: rerun reproduce to resume it")
    return folders


def facts(checkpoint: Checkpoint, *, steps: int) -> dict[str, Any]:
    """What a model card says of a training. steps: of gradient, in all; the checkpoint is of the best of them."""
    about = _public(checkpoint.provenance, checkpoint)
    return {
        "training_seed": checkpoint.config["seed"],
        "steps": steps,
        "best_step": about["step"],
        "validation_loss": _loss(checkpoint),
        "transitions": sum(data["transitions"] for data in about["data"]),
        "episodes": sum(data["episodes"] for data in about["data"]),
        "training_windows": about["training_windows"],
        "validation_windows": about["validation_windows"],
        "parameters": {part: found for part in PARTS if (found := _parameters(checkpoint, part))},
        "command": about["command"],
        "revision": about["revision"],
    }


def _loss(checkpoint: Checkpoint) -> float:
    return float(checkpoint.provenance["metrics"]["validation_loss"])


def _parameters(checkpoint: Checkpoint, part: str) -> int:
    return sum(value.numel() for name, value in checkpoint.tensors.items() if name.startswith(f"{part}."))


def _public(record: Mapping[str, Any], checkpoint: Checkpoint) -> dict[str, Any]:
    """A record without the paths of the reproduction on the machine that trained: its `output` is HOME/train/NAME.

    The PointNet may be another reproduction's, with `output=HOME/pretrain`.
    """
    arguments = [argument for text in _strings(record) for argument in _arguments(text)]
    pretrained = {found[1] for found in map(PRETRAINED.search, arguments) if found}
    homes = {Path(checkpoint.config["output"]).parent.parent, *map(Path, pretrained)}
    private = sorted((f"{home}/" for home in homes if home.name), key=len, reverse=True)  # one may lie in another
    quoted = [home.replace("'", "'\"'\"'") for home in private]  # as commands have it, whose arguments are quoted

    def public(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {public(name): public(entry) for name, entry in value.items()}
        if isinstance(value, list | tuple):
            return [public(entry) for entry in value]
        for home in (*private, *quoted) if isinstance(value, str) else ():
            value = value.replace(home, f"{PUBLIC_HOME}/")
        return value

    return {name: public(entry) for name, entry in record.items()}


def _strings(value: Any) -> Iterator[str]:
    """All texts within a record."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from (text for entry in value.values() for text in _strings(entry))
    elif isinstance(value, list | tuple):
        yield from (text for entry in value for text in _strings(entry))


def _arguments(command: str) -> list[str]:
    """The arguments of a command as a shell takes them, or the words of a text that is none."""
    try:
        return shlex.split(command)
    except ValueError:
        return command.split()


def _write(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint as `save_checkpoint` does, with public paths in its header."""
    config, provenance = (_public(getattr(checkpoint, name), checkpoint) for name in ("config", "provenance"))
    with atomic_write(path) as temporary:
        temporary.write_bytes(checkpoint_bytes(checkpoint.tensors, config, provenance))


def main() -> None:
    """Ship what the command line names, by default the three baselines of a run folder."""
    arguments, to = sys.argv[1:], shipped_folder()
    calibrated = len(arguments) == 3 and arguments[0] == "--calibrated"
    if not calibrated and (not arguments or arguments[0].startswith("-")):
        raise SystemExit(
            "usage: python -m cavin_pyro.storage.shipping RUN_FOLDER [METHOD ... | --models]\n"
            "       python -m cavin_pyro.storage.shipping --calibrated FILE NAME"
        )
    try:
        if calibrated:
            ship_calibrated(Path(arguments[1]), to / f"{arguments[2]}.safetensors")
            update_manifest(to)
            return
        if arguments[1:] == ["--models"]:
            print(*ship_models(Path(arguments[0]), to / "reproduction"), sep="\n")
            update_manifest(to)
            return
        for method in arguments[1:] or BASELINES:
            found = ship(Path(arguments[0]), method, to)
            print(
                f"{method}: training seed {found['training_seed']}, best step {found['best_step']} of "
                f"{found['steps']}, validation losses by seed {found['validation_losses']}"
            )
            update_manifest(to)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


if __name__ == "__main__":
    main()
