"""Repair of a guide that is not calibrated, and of intervals of f that do not hold what they say.

The guide: the sleep phase of wake-sleep (Hinton, Dayan, Frey and Neal, 1995; Bornschein and Bengio, "Reweighted
wake-sleep", 2015). The scales that f predicts: split conformal prediction. docs/how-to/check-a-model.md says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from omegaconf import DictConfig
from pyro import poutine
from scipy.stats import t as student
from torch import Tensor, nn

from cavin_pyro.config.commands import TrainerConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.guide import LEVEL, simulate
from cavin_pyro.criticism.intervals import assess_intervals
from cavin_pyro.criticism.loading import CheckContext, Loaded, context_of, load_trained
from cavin_pyro.criticism.pushing import MOVED
from cavin_pyro.criticism.section import Section
from cavin_pyro.data.collection import CollectionConfig
from cavin_pyro.data.dataset import content_record
from cavin_pyro.models.likelihoods import PredictedScales
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import Window
from cavin_pyro.storage.checkpoint import checkpoint_bytes, find_checkpoint
from cavin_pyro.storage.files import atomic_write, file_digest, write_json
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.training.elbo import Program, elbo_terms, substitute
from cavin_pyro.training.run import place
from cavin_pyro.training.trainer import unchecked_programs

CPU = torch.device("cpu")
OPTIONS = ("steps", "batch_size", "learning_rate", "wake_weight", "seed", "device")


def load_calibration(config: DictConfig) -> tuple[Loaded, CheckContext]:
    """The checkpoint with its data, and held-out windows for measurements.

    Raises:
        UserError: a checkpoint or data that cannot be used, an unknown part, or a model that has none of it.
    """
    path = find_checkpoint(config.checkpoint)

    def accept(model: Model) -> None:
        if "scales" in config.parts:
            check_scales(model)
        if not model.codes and "guide" in config.parts:
            raise UserError(
                f"checkpoint {path} has model {type(model).__name__}, which has no codes, so that there is no guide to "
                "calibrate"
            )

    loaded = load_trained(config, accept)
    context, _ = context_of(config, loaded, CollectionConfig())
    return loaded, context


def write_calibrated(folder: Path, config: DictConfig, loaded: Loaded, measured: dict[str, Any]) -> Path:
    """Write the checkpoint with guide and f's scales as they are now, and `calibration.json` beside it.

    Its provenance has a record for every calibration in `calibrated`: program, options, the SHA-256 of the file that
    was calibrated (`checkpoint`), fingerprints of the data, and what was `measured`.
    """
    checkpoint, path = loaded.checkpoint, folder / "checkpoint.safetensors"
    parts = {"guide": checkpoint.guide, "model": checkpoint.model}
    now = {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}
    changed = {name: value.detach().contiguous() for name, value in now.items() if name in checkpoint.tensors}
    record = {
        **provenance(),
        "parts": list(config.parts),
        **{name: config[name] for name in OPTIONS},
        "checkpoint": file_digest(checkpoint.path),
        "data": [content_record(data)["fingerprint"] for data in loaded.folders],
        **measured,
    }
    earlier = checkpoint.provenance.get("calibrated")
    about = {**checkpoint.provenance, "calibrated": [*(earlier if isinstance(earlier, list) else []), record]}
    with atomic_write(path) as temporary:
        temporary.write_bytes(checkpoint_bytes({**checkpoint.tensors, **changed}, checkpoint.config, about))
    write_json(folder / "calibration.json", record)
    return path


def print_change(before: Section, after: Section) -> None:
    """What the section of a check found before and after a calibration."""
    for when, section in (("before", before), ("after", after)):
        print("\n  ".join([f"{when}:", *section.findings]))


def calibrate_guide(config: DictConfig, loaded: Loaded, device: torch.device = CPU) -> None:
    """Fit the guide in place on the windows that its training saw, on a device.

    Model and guide are on the CPU before and after.
    """
    model, guide = loaded.checkpoint.model.to(device), loaded.checkpoint.guide.to(device)
    place(loaded.table, device)
    generator = torch.Generator().manual_seed(config.seed)
    torch.manual_seed(config.seed)

    def batch() -> Window:
        return loaded.table.batch(loaded.table.sample(config.batch_size, generator, bucketed=True))

    options = {name: config[name] for name in ("steps", "learning_rate", "wake_weight")}
    with unchecked_programs():
        sleep(model, guide, batch, **options)
    model.to(CPU), guide.to(CPU)


def sleep_loss(model: Model, guide: Program, window: Window) -> Tensor:
    """-log q(codes | simulated window), in nats, mean over windows simulated from the first states of windows `[B]`."""
    codes, simulated = simulate(model, window)
    trace: poutine.Trace = poutine.trace(substitute(guide, codes)).get_trace(simulated)
    return -torch.as_tensor(trace.log_prob_sum()) / len(window.actions)


def sleep(
    model: Model,
    guide: nn.Module,
    batch: Callable[[], Window],
    *,
    steps: int = 1500,
    learning_rate: float = 3e-3,
    wake_weight: float = 0.03,
) -> None:
    """Fit a guide by Adam, with training's cosine schedule and clipping of gradients; the model stays as it is.

    Args:
        batch: gives real windows `[B]`, other ones for each step. wake_weight: of -ELBO on these, beside the sleep
            loss on windows that are simulated from their first states.

    Raises:
        UserError: a loss that is not finite.
    """
    model.requires_grad_(False)
    guide.requires_grad_(True)
    optimizer = torch.optim.Adam(guide.parameters(), lr=learning_rate)
    as_training = TrainerConfig(steps=steps, learning_rate=learning_rate, schedule="cosine")
    with progress_bar("sleeping", total=steps) as bar:
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = as_training.rate(step)
            window = batch()
            total = sleep_loss(model, guide, window)
            if wake_weight:
                terms = elbo_terms(model, guide, window).values()
                total = total + wake_weight * (torch.stack(list(terms)).sum() / len(window.actions))
            if not math.isfinite(total.item()):
                raise UserError(f"calibration stopped after step {step}: the loss is not finite: lower learning_rate")
            optimizer.zero_grad(set_to_none=True)
            total.backward()
            nn.utils.clip_grad_norm_(guide.parameters(), as_training.clip_norm)
            optimizer.step()
            bar.update()
    guide.requires_grad_(False)


@runtime_checkable
class AdjustableScales(Protocol):
    """An f whose scales can be widened."""

    def widen(self, factor: float) -> None:
        """Multiply the scales of centres by `factor`."""


def check_scales(model: Model) -> None:
    """Refuse, by a UserError, a model whose f predicts no scales, or none that can be widened."""
    if not (isinstance(model.scales, PredictedScales) and isinstance(model.dynamics, AdjustableScales)):
        raise UserError(
            "parts=[scales] calibrates scales that f predicts, and this model's cannot be widened: choose "
            "parts=[guide], or train with dynamics=contact scales=predicted"
        )


def calibrate_f(context: CheckContext, windows: int, samples: int) -> tuple[float, Section, Section]:
    """Widen the scales that f predicts, in place, by half of the held-out episodes; measured on the other half.

    Args:
        windows: held-out ones, at most. samples: of each prediction, in measurements.

    Returns:
        The factor, and the section `intervals` before and after.

    Raises:
        UserError: fewer than two episodes, or nothing moved.
    """
    window, episodes = context.held_out(windows)
    order = torch.unique(episodes, return_inverse=True)[1]
    fitted, measured = (torch.nonzero(order % 2 == parity).flatten() for parity in (0, 1))
    if len(measured) == 0:
        raise UserError("all held-out windows are of one episode: collect more transitions")
    others = window.map(lambda field: field[measured])
    apart = replace(context, validation=others, validation_episodes=episodes[measured])
    before = assess_intervals(apart, windows=windows, samples=samples)
    factor = calibrate_scales(context.model, window.map(lambda field: field[fitted]))
    return factor, before, assess_intervals(apart, windows=windows, samples=samples)


@torch.no_grad()
def calibrate_scales(model: Model, window: Window) -> float:
    """Widen f's scales of centres so that 90 % intervals of x and y cover 90 % of the objects that moved over 1 cm.

    Returns the factor, the 90 % quantile of |error| / scale in `window: [B]`, which training must not have seen, over
    that of f's Student's t; Lei and others 2018, "Distribution-free predictive inference for regression". A UserError:
    nothing moved.
    """
    before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
    encoded = model.encode(window) if model.dynamics.reads_encoding else None
    mean, scales = model.dynamics.outcome(before, encoded, window.actions)
    assert scales is not None and isinstance(model.scales, PredictedScales)  # see `check_scales`
    moved = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    moved &= (after.centers - before.centers).norm(dim=-1) > MOVED
    if not moved.any():
        raise UserError("no object moved in the held-out windows: collect more transitions")
    ratio = ((after.centers - mean.centers)[..., :2].abs() / scales[..., :1])[moved]
    factor = float(ratio.flatten().quantile(LEVEL) / student.ppf(0.5 + LEVEL / 2, model.scales.degrees_of_freedom))
    assert isinstance(model.dynamics, AdjustableScales)
    model.dynamics.widen(factor)
    return factor
