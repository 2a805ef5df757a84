"""The chosen episodes of a task, step by step: a row of panels for each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cavin_pyro.reproduction.episodes.choice import EACH, caption, choose
from cavin_pyro.reproduction.episodes.replay import Replay, replay
from cavin_pyro.reproduction.figure import DOTS_PER_INCH
from cavin_pyro.reproduction.table import Row
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.plan import (
    FAILURE_COLOR,
    PANELS,
    SUCCESS_COLOR,
    draw_end,
    draw_plan_record,
    draw_return_scale,
    legend,
    return_scale,
    spread_plans,
)

COLUMNS = PANELS + 1  # and the end


def draw_chosen_episodes(home: Path, folders: Sequence[Path], rows: Sequence[Row], criterion: str) -> list[Path]:
    """Replay and draw the chosen episodes of every task, `episodes-TASK-CRITERION.png`; returns the pictures' paths.

    Args:
        folders: of the reproduction or, if it was joined from shards, of the shards.

    Raises:
        UserError: as `replay`.
    """
    paths = []
    for task in dict.fromkeys(row["task"] for row in rows):
        chosen = choose(rows, task, criterion)
        if chosen.rows:
            replays = [replay(folders, row, criterion) for row in chosen.rows]
            paths.append(home / f"episodes-{task}-{criterion}.png")
            draw_replays(paths[-1], task, replays, criterion)
    return paths


def draw_replays(path: Path, task: str, replays: Sequence[Replay], criterion: str) -> None:
    """Draw replayed episodes below one another: at most five plans of each, evenly spread, and its end."""
    shown = [spread_plans(one.episode) for one in replays]
    returns = [record.plan.candidate_returns[0].numpy() for records in shown for record in records]
    scale = return_scale(np.concatenate(returns))
    figure = Figure(figsize=(2.9 * COLUMNS + 0.6, 1.2 + 2.2 * len(replays)), dpi=DOTS_PER_INCH, layout="constrained")
    body, side = figure.subfigures(1, 2, width_ratios=(1.0, 0.055))
    parts = body.subfigures(len(replays), 1, squeeze=False)[:, 0]
    for part, one, records in zip(parts, replays, shown, strict=True):
        won = one.row[f"{criterion}_outcome"] == "success"
        color = SUCCESS_COLOR if won else FAILURE_COLOR
        part.suptitle(caption(one.row, criterion), fontsize=11, fontweight="bold", color=color, x=0.01, ha="left")
        panels = part.subplots(1, COLUMNS)
        for panel, record in zip(panels, records, strict=False):
            draw_plan_record(panel, record, one.task, one.camera, scale, one.episode.reached(record))
        draw_end(panels[len(records)], one.episode, one.task, one.camera)
        for panel in panels:
            panel.title.set_fontsize(8)
        for panel in panels[len(records) :]:
            panel.set_axis_off()
    if scale is not None:
        draw_return_scale(figure, scale, cax=side.add_axes((0.1, 0.35, 0.2, 0.3)))
    handles = legend(replays[0].task, [record for records in shown for record in records], candidates=scale is not None)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    figure.suptitle(_title(task, replays, criterion), fontsize=13)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor="white", metadata={"Software": None})


def _title(task: str, replays: Sequence[Replay], criterion: str) -> str:
    won = sum(one.row[f"{criterion}_outcome"] == "success" for one in replays)
    found = f"{_counted(won, 'success', 'successes')}, {_counted(len(replays) - won, 'failure', 'failures')}"
    return f"{task}, CAVIN, planner as in the paper; criterion: {criterion}; {found}"


def _counted(count: int, one: str, several: str) -> str:
    if count == EACH:
        return f"the first {count} {several}"
    if count == 0:
        return f"no {one} in the table"
    return f"{count} {one if count == 1 else several} (the table has no more)"
