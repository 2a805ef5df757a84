"""Stochastic variational inference: the loop, its validation, its checkpoints, and exact resuming.

Optimizers of torch over the ELBO as a module, because Pyro's own keep one per parameter and take more time than these
small networks.
"""

from __future__ import annotations

import csv
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path

import pyro
import torch
from torch import Tensor, nn

from cavin_pyro.config.commands import TrainerConfig
from cavin_pyro.config.device import send, set_matmul_precision
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.parts import PARTS
from cavin_pyro.data.windows import WindowTable
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State, Window
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.training.cuda_graphs import CapturedLoss, capturable
from cavin_pyro.training.elbo import elbo_terms, first_nonfinite, term_counts
from cavin_pyro.training.objectives import Objective
from cavin_pyro.training.resume import (
    forked,
    load_optimizer,
    optimizer_tensors,
    random_states,
    restore_random_states,
    resuming,
    section,
    write_resume,
)

VALIDATION_BATCH = 1024  # windows at once, which bounds the memory

Row = dict[str, float]


class Trainer:
    """Trains one model and guide on windows, all on their device.

    `objective`: what is minimised. `folder`: where metrics and the resume file go. `seed`: of batches and codes.
    `save`: called with the step and the metrics whenever the validation loss is the best so far.
    """

    def __init__(
        self,
        model: Model,
        guide: Guide,
        objective: Objective,
        windows: WindowTable,
        folder: Path,
        save: Callable[[int, Row], None],
        config: TrainerConfig | None = None,
        *,
        seed: int = 0,
        mirror_signs: Tensor | None = None,
    ) -> None:
        """`mirror_signs: [F]`, of features: with them every other window is mirrored, at random."""
        self.model, self.guide, self.windows = model, guide, windows
        self._programs = nn.ModuleDict({"model": model, "guide": guide})
        self.config = config = config or TrainerConfig()
        self.folder, self._save, self._seed = folder, save, seed
        # A guide that infers no other windows is fitted to one batch, for good.
        self._fixed = None if guide.amortized else fixed_windows(windows, config.batch_size, seed)
        if self._fixed is not None:
            guide(windows.batch(self._fixed))  # makes its parameters
        self._loss = objective.loss(model, guide)
        self._captured: CapturedLoss | None = None
        self._mirror_signs = None if mirror_signs is None else mirror_signs.to(windows.device)
        trained = [parameter for parameter in self._loss.parameters() if parameter.requires_grad]
        trained = trained or [*self._loss.requires_grad_(True).parameters()]  # of a checkpoint, as `load` froze it
        self._optimizer = torch.optim.Adam(trained, lr=config.learning_rate, fused=True)
        self._batches = torch.Generator().manual_seed(seed)
        set_matmul_precision(config.matmul_precision)
        torch.manual_seed(seed)
        self.step, self.best, self.best_step, self.stale = 0, math.inf, 0, 0
        self.rows: list[Row] = []

    def run(self) -> None:
        """Train until the steps are done or patience is lost; resumes from the resume file if it exists.

        A loss or gradient that is not finite is a `UserError` that names the term.
        """
        self.resume()
        self._check_programs()
        config, running, since = self.config, 0.0, time.perf_counter()
        steps = config.steps if self.stale < config.patience else self.step
        with (
            warnings.catch_warnings(),
            unchecked_programs(),
            progress_bar("training", total=steps, initial=self.step) as bar,
        ):
            # Pyro warns many times about one NaN; this loop checks and stops.
            warnings.filterwarnings("ignore", "Encountered", UserWarning)
            while self.step < config.steps and self.stale < config.patience:
                window = self._sample()
                running += self._loss_and_gradients(window)
                norm = nn.utils.clip_grad_norm_(self._loss.parameters(), config.clip_norm)
                if not math.isfinite(norm.item()):
                    self._stop_at("gradient")
                self._optimizer.param_groups[0]["lr"] = config.rate(self.step)
                self._optimizer.step()
                self.step += 1
                bar.update()
                if self.step % config.validate_every == 0 or self.step == config.steps:
                    count = self.step - (int(self.rows[-1]["step"]) if self.rows else 0)
                    windows_per_second = count * config.batch_size / (time.perf_counter() - since)
                    row = self._validate(running / count, windows_per_second)
                    self._keep(row)
                    bar.set_postfix(validation=f"{row['validation_loss']:.1f}", best=f"{self.best:.1f}")
                    running, since = 0.0, time.perf_counter()

    def _sample(self) -> Window:
        """A batch of training windows, some of them mirrored if there are mirror signs."""
        config, indices = self.config, self._fixed
        if indices is None:
            indices = self.windows.sample(config.batch_size, self._batches, bucketed=config.batches == "bucketed")
        window = self.windows.batch(indices)
        if self._mirror_signs is not None:
            mirrored = torch.rand(len(indices), generator=self._batches) < 0.5
            window = reflect(window, send(mirrored, self.windows.device), self._mirror_signs, self.model.space)
        return window

    def _loss_and_gradients(self, window: Window) -> float:
        """The mean loss of a batch, with its gradients in the parameters."""
        if self._captured is not None:
            try:
                loss = self._captured(window)
            except RuntimeError as error:  # the base class of CUDA's errors
                self._captured = None
                said = f"from step {self.step} on, steps run eagerly, since the loss cannot be captured as a CUDA graph"
                print(f"{said}: {(str(error).splitlines() or [repr(error)])[0]}", file=sys.stderr, flush=True)
        if self._captured is None:
            self._optimizer.zero_grad(set_to_none=True)
            loss = self._loss(window, self.step) / len(window.sequence_mask)
        if not math.isfinite(value := loss.item()):
            self._stop_at(first_nonfinite(elbo_terms(self.model, self.guide, window)) or "loss")
        if self._captured is None:
            loss.backward()
        return value

    def _validate(self, training_loss: float, windows_per_second: float) -> Row:
        """The metrics of a validation, which are also the last of `rows`."""
        terms, loss = self._validation_terms()
        if not math.isfinite(loss):
            self._stop_at(first_nonfinite(terms) or "loss")
        row = {"step": float(self.step), "training_loss": training_loss, "validation_loss": loss}
        row |= {f"validation_{name}": value for name, value in terms.items()}
        row |= {"learning_rate": self.config.rate(self.step), "windows_per_second": windows_per_second}
        self.rows.append(row)
        return row

    def _validation_terms(self) -> tuple[Row, float]:
        """Terms of the validation windows, and the loss per window, always with the same noise.

        Each term of the bound is a mean over all windows or transitions that count for it, each other term over all
        windows.
        """
        indices, device = self.windows.validation, self.windows.device
        chosen = indices[torch.randperm(len(indices), generator=torch.Generator().manual_seed(0))]
        sums: Row = {}
        counts: dict[str, int] = {}
        parts: Sequence[Tensor] = chosen[: self.config.validation_windows].split(VALIDATION_BATCH)
        loss, parts = 0.0, parts if self._fixed is None else [self._fixed]
        with forked(device), torch.no_grad(), pyro.validation_enabled(False):
            torch.manual_seed(0)
            for part in parts:
                window = self.windows.batch(part)
                with self.model.encoding(window):
                    bound = elbo_terms(self.model, self.guide, window)
                others = self._loss.terms_of_model(window)
                terms = {name: term.item() for name, term in {**bound, **others}.items()}
                loss += sum(terms[name] for name in bound)
                for name in others:
                    loss += terms[name]
                for name, count in {**term_counts(bound, window), **dict.fromkeys(others, len(part))}.items():
                    sums[name], counts[name] = sums.get(name, 0.0) + terms[name], counts.get(name, 0) + count
        means = {name: value / max(1, counts[name]) for name, value in sums.items()}
        return means, loss / sum(len(part) for part in parts)

    def _keep(self, row: Row) -> None:
        """Save the best checkpoint, the metrics, and the state from which a killed run resumes."""
        if row["validation_loss"] < self.best:
            self.best, self.best_step, self.stale = row["validation_loss"], self.step, 0
            self._save(self.step, row)
        else:
            self.stale += 1
        with atomic_write(self.folder / "metrics.csv") as temporary, open(temporary, "w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(self.rows[0]))
            writer.writeheader()
            writer.writerows(self.rows)
        tensors = random_states(self.windows.device) | {"batches": self._batches.get_state()}
        tensors |= self._programs.state_dict()
        write_resume(self.resume_path, tensors | optimizer_tensors(self._optimizer), {"rows": self.rows})

    @property
    def resume_path(self) -> Path:
        """The file with the complete state of training at the last validation."""
        return self.folder / "resume.safetensors"

    @user_input(*PARTS)
    def _check_programs(self) -> None:
        """Let Pyro validate model and guide once, instead of in every step."""
        window = self.windows.batch(self.windows.training[:2] if self._fixed is None else self._fixed)
        with forked(self.windows.device):  # with gradients, which TraceEnum_ELBO demands
            self._loss(window, self.step)
        if self.config.cuda_graphs and self.windows.device.type == "cuda" and capturable(self._loss, window):
            self._captured = CapturedLoss(self._loss)

    def _stop_at(self, term: str) -> None:
        kept = f"the best checkpoint, of step {self.best_step}, stays" if self.rows else "there is no checkpoint yet"
        raise UserError(
            f"training stopped after step {self.step}: the term {term} is not finite; {kept}: "
            "look at the data, or lower trainer.learning_rate"
        )

    def resume(self) -> None:
        """Take over the state in the resume file, if there is one; a damaged one is a `UserError`."""
        if self.step or not self.resume_path.exists():
            return
        with resuming(self.resume_path) as (tensors, state):
            for part, module in self._programs.items():
                module.load_state_dict(section(tensors, part))
            load_optimizer(self._optimizer, tensors)
            self.rows = [{name: float(value) for name, value in row.items()} for row in state["rows"]]
            best = min(self.rows, key=itemgetter("validation_loss"))  # the first of equals
            self.step, self.best = int(self.rows[-1]["step"]), best["validation_loss"]
            self.best_step = int(best["step"])
            self.stale = sum(row["step"] > self.best_step for row in self.rows)
            self._batches.set_state(tensors["batches"])
            restore_random_states(tensors, self.windows.device, self._seed + self.step)


def reflect(window: Window, which: Tensor, signs: Tensor, space: Space) -> Window:
    """Mirror some of the windows `[B]` as the space says that its world may be.

    `which`: `[B]` bool. `signs`: `[F]`, of features.
    """
    states, signs_of = window.states, window.actions.new_tensor(space.mirror)
    mirror, signs = (torch.where(which[:, None, None, None], one, 1.0) for one in (signs_of, signs))
    centers = states.centers * mirror + (1.0 - mirror) * mirror.new_tensor(space.origin)
    actions = window.actions * torch.cat([mirror[:, 0, :, :size] for size in space.action_sizes], -1)
    return window._replace(states=State(centers, states.features * signs, states.mask), actions=actions)


def fixed_windows(windows: WindowTable, count: int, seed: int) -> Tensor:
    """Numbers of at most `count` training windows that count for all terms, the same ones for the same seed."""
    counted = windows.training[windows.sequence_mask[windows.training]]
    order = torch.randperm(len(counted), generator=torch.Generator().manual_seed(seed))
    return counted[order[:count]]


@contextmanager
def unchecked_programs() -> Iterator[None]:
    """Disable Pyro's checks of sites, which take a twentieth of every step of a small model."""
    with pyro.settings.context(validate_infer=False, validate_poutine=False):
        yield
