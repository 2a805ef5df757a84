"""Options of the paper's baselines, tried with the same care: `python benchmarks/tuning.py HOME [--steps 4000]`.

HOME is a folder of `python -m cavin_pyro.reproduce` whose `data/` and `pretrain/` are finished. Each variant differs
from the paper's version of its method in one option, is trained on the same data with the same steps and seed, and
plans as in the paper (no additions) in the same scenes, seeds from 20000 on. The table goes to HOME/tuning/table.md.
Finished parts are not done again.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.evaluation import append, begin, missing_seeds, run_jobs, seeds_of
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.reproduction.methods import METHODS, PAPER_METHODS
from cavin_pyro.reproduction.pipeline import SHARED
from cavin_pyro.reproduction.scales import QUICK_TRAINING, TASKS
from cavin_pyro.reproduction.stages import Stage, run_stages
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.training.trainer import read_rows

FIRST_SCENE = 20_000


class Variant(NamedTuple):
    """A method with other options of its training."""

    method: str
    name: str
    options: tuple[str, ...]

    @property
    def folder(self) -> str:
        """Its name as a folder's."""
        return f"{self.method}-{self.name.replace(' ', '-')}"


VARIANTS = (
    Variant("cavin", "codes 16 and 16", ()),
    Variant("sectar", "code 32", ("model.action_weight=1",)),
    Variant("sectar", "code 16", ("model.effect_dimension=16", "model.action_weight=1")),
    Variant("sectar", "code 64", ("model.effect_dimension=64", "model.action_weight=1")),
    Variant("sectar", "action weight 0.01", ("model.action_weight=0.01",)),
    Variant("sectar", "action weight 0.1", ("model.action_weight=0.1",)),
    Variant("sectar", "action weight 10", ("model.action_weight=10",)),
    Variant("sectar", "guide reads actions", ("guide.reads_actions=true", "model.action_weight=1")),
    Variant("cvae_mpc", "code 32", ("model.motion_dimension=32",)),
    Variant("cvae_mpc", "code 16", ("model.motion_dimension=16",)),
    Variant("cvae_mpc", "code 64", ("model.motion_dimension=64",)),
    Variant("mpc", "no codes", ()),
)


def training(home: Path, variant: Variant, steps: int, more: list[str]) -> Stage:
    """As in a reproduction, with the variant's options and fewer steps."""
    options = (
        f"data={home / 'data'}",
        f"pointnet={home / 'pretrain' / 'pointnet.safetensors'}",
        *QUICK_TRAINING,
        f"trainer.steps={steps}",
        *METHODS[variant.method].training,
        *variant.options,
        *more,
    )
    return Stage("train", options, home / "tuning" / variant.folder, "training.png", 1.0)


def evaluate(
    home: Path, variants: list[Variant], episodes: int, workers: int, more: list[str]
) -> dict[tuple[Variant, str], list[Any]]:
    """The episodes of every variant and task, sparse rewards, 3 objects, the paper's planners."""
    rows, jobs, owners = {}, [], []
    for variant in variants:
        for task in TASKS:
            folder = home / "tuning" / variant.folder / task
            folder.mkdir(exist_ok=True)
            config = compose(
                "evaluate",
                f"task={task}",
                *SHARED,
                *METHODS[variant.method].planners["paper"],
                *more,
                f"checkpoint={folder.parent / 'checkpoint.safetensors'}",
                f"episodes={episodes}",
                f"seed={FIRST_SCENE}",
                f"output={folder}",
            )
            rows[variant, task] = begin(folder)
            for seed in missing_seeds(seeds_of(config), rows[variant, task]):
                jobs.append((config, seed))
                owners.append((variant, task, folder))
    with (
        closing(run_jobs(jobs, workers)) as finished,
        progress_bar("evaluating", total=len(jobs), unit="episode") as bar,
    ):
        for number, row in finished:
            variant, task, folder = owners[number]
            rows[variant, task][row["seed"]] = row
            append(folder, row)
            bar.update()
    return {key: list(found.values())[:episodes] for key, found in rows.items()}


def table(home: Path, variants: list[Variant], rows: dict[tuple[Variant, str], list[Any]]) -> str:
    """Validation loss per window, and successes by the published criterion, with those by the strict one."""
    lines = [
        f"| method | variant | validation loss | {' | '.join(TASKS)} | all | 95 % interval |",
        "| --- | --- | --- |" + " --- |" * (len(TASKS) + 2),
    ]
    for variant in variants:
        loss = min(row["validation_loss"] for row in read_rows(home / "tuning" / variant.folder / "metrics.csv"))
        entries, total, count = [], 0, 0
        for task in TASKS:
            published, strict = (
                sum(row[name] == "success" for row in rows[variant, task]) for name in ("outcome", "strict_outcome")
            )
            total, count = total + published, count + len(rows[variant, task])
            entries.append(f"{published} ({strict})")
        interval = wilson(total, count)
        label = METHODS[variant.method].label
        lines.append(
            f"| {label} | {variant.name} | {loss:.1f} | {' | '.join(entries)} | {total} of {count} | "
            f"{100 * interval['low']:.0f} to {100 * interval['high']:.0f} % |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("home", type=Path)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--episodes", type=int, default=15, help="of every variant in each task")
    parser.add_argument("--methods", nargs="+", default=PAPER_METHODS, choices=METHODS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--training", nargs="*", default=[], help="further options of train")
    parser.add_argument("--planning", nargs="*", default=[], help="further options of evaluate")
    given = parser.parse_args()
    chosen = [variant for variant in VARIANTS if variant.method in given.methods]
    stages = [training(given.home, variant, given.steps, given.training) for variant in chosen]
    run_stages(stages, given.workers, lambda: None)
    rows = evaluate(given.home, chosen, given.episodes, given.workers, given.planning)
    text = table(given.home, chosen, rows)
    with atomic_write(given.home / "tuning" / "table.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(text, end="")


if __name__ == "__main__":
    main()
