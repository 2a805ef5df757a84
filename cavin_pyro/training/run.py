"""A training run, from its configuration to a folder with checkpoint and metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyro
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from pyro.infer import ELBO, Trace_ELBO
from safetensors.torch import load_file
from torch import Tensor, nn

from cavin_pyro.config.commands import DEFAULT_CHECKPOINT, TrainerConfig, WindowConfig
from cavin_pyro.config.device import choose_device
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.options import MAXIMUM_SEED, configured, constructor_options, shown
from cavin_pyro.config.parts import PARTS, Config, amortized_guides, build_guide, build_model, build_part, describe
from cavin_pyro.data.dataset import content_record, read_metadata, slots_of
from cavin_pyro.data.features import geometry_fingerprint
from cavin_pyro.data.windows import WindowTable, load_windows, shared_space
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.checks import check_last, check_number, typed
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.space import Space
from cavin_pyro.storage.checkpoint import POINTNET, load, read_checkpoint, save
from cavin_pyro.storage.files import file_digest, output_folder, write_json
from cavin_pyro.storage.geometry import check_fit, chosen_geometry
from cavin_pyro.storage.provenance import provenance as of_this_process
from cavin_pyro.storage.run_directory import check_same_data, check_same_run, write_config
from cavin_pyro.training.compatibility import check_compatibility
from cavin_pyro.training.objectives import Objective, as_objective
from cavin_pyro.training.trainer import Trainer, fixed_windows

FREE = ("data", "output", "device", "trainer.patience")  # options that may differ when a training resumes
UNVALIDATED = {"validate_distributions_pyro": False, "validate_distributions_torch": False}
DATA_SHARE = 0.5  # of a GPU's free memory, which states and actions may take; the rest is for steps


def train(config: DictConfig) -> Trainer:
    """Run a whole training, from its configuration to a folder with checkpoint and metrics, or to a `UserError`."""
    with output_folder(config.output) as folder:
        config.device = choose_device(config.device).type
        selection = configured(WindowConfig, config.windows, "windows")
        data = data_folders(config.data)
        made = of_world(config, data)
        torch.manual_seed(config.seed)
        model = build_model(config)
        guide = build_guide(config, model)
        objective = build_objective(config, model, guide)
        geometry, origin = chosen_geometry(config) if made is None else (None, {})
        started = start_from(config, model, guide, geometry) if config.initial else {}
        train_only(config.trained, model, guide)
        _mirror_signs(config.trainer.reflect, model, geometry, guide)
        check_same_run(folder, config, ignore=free(config.trainer.schedule))
        most = max(slots_of(read_metadata(one)) for one in data)
        check_fit(model, geometry, most, features=made["features"] if made else None)
        options = {"segment_length": config.model.segment_length, "seed": config.seed}
        windows = load_windows(data, geometry, selection, storage=folder, **options)
        record = {"data": [content_record(one) for one in data], **origin}
        record |= {"training_windows": len(windows.training), "validation_windows": len(windows.validation)}
        return fit(
            model,
            guide,
            windows,
            objective=objective,
            geometry=geometry,
            output=folder,
            config=config,
            provenance={**record, **started},
            seed=config.seed,
            device=config.device,
            **config.trainer,
        )


@typed(UserError)
def fit(
    model: Model,
    guide: Guide,
    windows: WindowTable,
    *,
    objective: Objective | ELBO | None = None,
    geometry: Geometry | None = None,
    output: str | Path | None = None,
    config: Config | None = None,
    provenance: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: str = "cpu",
    **trainer: Any,
) -> Trainer:
    """Train a model and its guide by stochastic variational inference; resumes an interrupted run in `output`.

    run = cavin_pyro.fit(model, guide, windows, steps=2000, learning_rate=1e-3, output="runs/mine")

    Args:
        windows: of data (`cavin_pyro.data.windows.load_windows`) or of arrays (`WindowTable.from_episodes`).
        objective: a bound of Pyro's or `cavin_pyro.training.objectives.Objective`, by default `Trace_ELBO`.
        geometry: what made the windows' features, for the checkpoint and for `reflect`.
        output: folder for `checkpoint.safetensors`, which `load` and the commands read, and for metrics; by default
            nothing is written.
        config, provenance: what the checkpoint says of itself, as in `cavin_pyro.save`.
        seed: of batches and codes. device: cpu, cuda or auto; model and guide stay there.
        trainer: options of `cavin_pyro.config.commands.TrainerConfig`: steps, batch_size, learning_rate and others.

    Returns:
        The run: `rows` of metrics, `best` validation loss and `best_step`, whose weights model and guide have.

    Raises:
        UserError: parts that do not fit together, an option out of its range, or a loss that is not finite.
    """
    options, place_of = configured(TrainerConfig, trainer, "trainer"), choose_device(device)
    if unknown := sorted(set(trainer) - set(vars(options))):
        raise UserError(f"fit has no option {unknown[0]!r}: choose from {', '.join(vars(options))}")
    with user_input():
        check_number("seed", seed, 0, MAXIMUM_SEED, whole=True)
        _check_parts(model, guide, windows, geometry)
        objective = as_objective(Trace_ELBO(max_plate_nesting=1) if objective is None else objective)
        objective.check(model, guide)
    signs = _mirror_signs(options.reflect, model, geometry, guide)
    stored: Any = dict(config or {})
    if "model" not in stored and output is not None:
        parts = describe(model=model, guide=guide, geometry=geometry)
        stored = {**parts, "trainer": vars(options), "seed": seed, **windows.selection, **stored}
    programs = nn.ModuleDict({"model": model, "guide": guide}).to(place_of)
    best: dict[str, Tensor] = {}
    with (
        pyro.settings.context(module_local_params=True, **UNVALIDATED),
        TemporaryDirectory() if output is None else output_folder(output) as name,
    ):
        folder, where = Path(name), place(windows, place_of)
        path = folder / "checkpoint.safetensors"
        if guide.amortized:
            check_compatibility(model, guide, windows.batch(windows.training[:2]), objective.elbo)
        _announce(model, guide, windows, options.batch_size, seed, where)
        record = {**of_this_process(), **(provenance or {})}
        if output is not None:
            stored = OmegaConf.create(stored)
            check_same_run(folder, stored, ignore=free(options.schedule))
            check_same_data(folder, record.get("data") or [windows.content_record()])

        def keep(step: int, row: dict[str, float]) -> None:
            best.update({name: value.clone() for name, value in programs.state_dict().items()})
            if output is not None:
                about = {**record, "step": step, "metrics": row}
                save(path, model=model, guide=guide, geometry=geometry, config=stored, provenance=about)

        run = Trainer(model, guide, objective, windows, folder, keep, options, seed=seed, mirror_signs=signs)
        run.resume()
        if run.step > options.steps:
            raise UserError(f"{folder} holds a run of {run.step} steps: give trainer.steps= at least as many")
        if output is not None:
            stored = write_config(folder, stored)
        if run.rows:
            _keep_best(run, path, keep)
            best.update({name: value for name, value in load_file(path).items() if name in programs.state_dict()})
        own = not all(type(one).__module__.startswith("cavin_pyro.") for one in (model, guide, objective))
        with user_input(*PARTS) if own else nullcontext():
            run.run()
        programs.load_state_dict(best)
        row = next(row for row in run.rows if row["step"] == run.best_step)
        write_json(folder / "metrics.json", {**record, "steps": run.step, "best": row})
    return run


def _check_parts(model: Model, guide: Guide, windows: WindowTable, geometry: Geometry | None) -> None:
    """Raise an error for a guide of another model, or windows of other sizes or features than the model's."""
    if geometry is not None:
        check_fit(model, geometry)
        if windows.geometry not in (None, geometry_fingerprint(geometry)):
            raise ValueError(f"the windows' features are not of this {type(geometry).__name__}: give what made them")
    if guide.model is not model:
        raise ValueError("the guide was built for another model: build one for this model, or give guide.model")
    if other := {one.dtype for part in (model, guide) for one in part.parameters()} - {torch.float32}:
        raise ValueError(f"weights must be float32, not {other.pop()}: call float() of model and guide")
    model.check_priors()
    one = windows.batch(windows.training[:1])
    model.space.check(one.states, model.feature_dimension)
    check_last("actions of the windows", one.actions, model.space.actions)
    if windows.objects > (most := model.maximum_objects):
        raise ValueError(f"the windows have {windows.objects} objects, and the model takes {most}: build it for them")


def _announce(model: Model, guide: Guide, windows: WindowTable, batch_size: int, seed: int, where: str) -> None:
    """Print which windows model and guide learn from."""
    if guide.amortized:
        print(f"{len(windows.training)} training windows, {len(windows.validation)} for validation{where}")
        return
    print(
        f"{len(fixed_windows(windows, batch_size, seed))} of {len(windows.training)} training windows "
        f"(trainer.batch_size), for validation too{where}: "
        f"guide {type(guide).__name__} has parameters for each window, which other batches cannot train; "
        f"guides that infer any window: {', '.join(amortized_guides(model.name))}"
    )


def free(schedule: str) -> tuple[str, ...]:
    """Options that may differ when a training goes on: its steps too, unless their number decides every rate."""
    return FREE if schedule == "cosine" else (*FREE, "trainer.steps")


def data_folders(data: str | Sequence[str]) -> list[Path]:
    """The option `data`: a folder, or a list of them; anything else is a `UserError`."""
    folders = [data] if isinstance(data, str) else data
    listed = isinstance(folders, Sequence | ListConfig) and all(isinstance(one, str) and one for one in folders)
    if not listed or not folders:
        raise UserError(f"data must be a dataset folder from collect, or a list of them, not {shown(data)}")
    return [Path(folder) for folder in folders]


def of_world(config: DictConfig, folders: Sequence[Path]) -> dict[str, Any] | None:
    """What datasets say of another world than the tabletop, None of that: its space and sizes become the model's.

    No dataset, datasets of different worlds, or geometric features where there are no clouds are a `UserError`.
    """
    space, made = shared_space(folders), read_metadata(folders[0])["configuration"]
    if space is None:
        return None
    if config.geometry.get("_target_") != POINTNET or config.pointnet != DEFAULT_CHECKPOINT:
        raise UserError(f"data of {made['world']['_target_']} have no point clouds: leave geometry= and pointnet=")
    config.geometry = {"_target_": None}
    config.space, config.world = {"_target_": f"{Space.__module__}.Space", **made["space"]}, made["world"]
    usual = constructor_options(config.model["_target_"])
    for name, own in (("feature_dimension", made["features"]), ("maximum_objects", made["objects"])):
        if name in usual and config.model[name] == usual[name].default:  # the user chose no other
            config.model[name] = own
    return dict(made)


def build_objective(config: Config, model: Model, guide: Guide | None = None) -> Objective:
    """The objective, from the section `objective`; one that model or guide cannot have is a `UserError`."""
    with user_input("objective"):
        objective = as_objective(build_part("objective", config["objective"]))
        objective.check(model, guide)
    return objective


def start_from(config: DictConfig, model: Model, guide: Guide, geometry: Geometry | None) -> dict[str, Any]:
    """Copy the weights of the checkpoint `config.initial` into model and guide; other parts are a `UserError`.

    Returns its digest and provenance, for that of the new one.
    """
    checkpoint = load(config.initial)
    if checkpoint.model.space != model.space:
        raise UserError(f"checkpoint {checkpoint.path} is of another world than the data: their spaces differ")
    checkpoint.load_into("model", model)
    checkpoint.load_into("guide", guide)
    theirs, ours = (one and geometry_fingerprint(one) for one in (checkpoint.geometry, geometry))
    if theirs != ours:
        raise UserError(
            f"checkpoint {checkpoint.path} was trained with other geometric features: give its geometry= or pointnet="
        )
    return {"initial": {"sha256": file_digest(checkpoint.path), "provenance": checkpoint.provenance}}


def train_only(names: Sequence[str], model: Model, guide: Guide) -> None:
    """Leave the weights of all parts but these, of the model or `guide`, as they are; no names stand for all parts."""
    parts = {name: part for name, part in (*model.named_children(), ("guide", guide)) if [*part.parameters()]}
    if unknown := [name for name in names if name not in parts]:
        raise UserError(f"trained has {unknown[0]!r}, which is no part of this model: choose from {', '.join(parts)}")
    for name, part in parts.items():
        part.requires_grad_(not names or name in names)


def _mirror_signs(reflect: bool, model: Model, geometry: Geometry | None, guide: Guide) -> Tensor | None:
    if not reflect:
        return None
    space = model.space
    signs = geometry.mirror_signs() if geometry else torch.tensor([*space.mirror_features])
    if signs is None or not (len(signs) and space.mirror):
        own = type(geometry).__name__ if geometry and signs is None else ""
        lacking = f"{own} has none: pass geometry=outline" if own else "the space lacks mirror or mirror_features"
        raise UserError(f"trainer.reflect needs a mirror image; {lacking}, or leave trainer.reflect")
    with user_input():
        check_last("mirror_features of the space", signs, model.feature_dimension)
    if not guide.amortized:
        raise UserError(f"trainer.reflect needs a guide that infers any window, and {type(guide).__name__} does not")
    return signs


def place(windows: WindowTable, device: torch.device) -> str:
    """Move the windows to a device; returns what there is to say about where they lie."""
    if device.type == "cpu":
        return ""
    free = torch.get_device_module(device).mem_get_info(device)[0]  # bytes
    kept = windows.move(device, int(DATA_SHARE * int(free)))
    return ", all in the memory of the GPU" if kept else ", which are copied to the GPU batch by batch"


def _keep_best(run: Trainer, path: Path, save: Callable[[int, dict[str, float]], None]) -> None:
    """Make sure that a resumed run still has its best checkpoint, which a later validation need not surpass."""
    if not path.exists() and run.best_step == run.step:
        save(run.step, run.rows[-1])
    wanted = f"the best checkpoint of this run, of step {run.best_step}, and later weights cannot replace it"
    then = f"restore it, delete {run.resume_path.name} to start again, or choose another output=DIR"
    with user_input(where=f"{path} is {wanted}: {then}"):
        read_checkpoint(path)
