"""A plan in 3D, for the rerun viewer: the same candidates, chains, pushes and predictions as in the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from cavin_pyro.evaluation.rollout import PlanRecord
from cavin_pyro.visualization.overlay import (
    OBSTACLE_COLOR,
    PREDICTION_COLOR,
    PUSH_COLOR,
    REACHED_COLOR,
    SUBGOAL_COLOR,
    candidate_subgoals,
    predicted_paths,
    pushes,
    reached_paths,
    subgoal_chains,
)
from cavin_pyro.visualization.panel import RETURNS
from cavin_pyro.visualization.plan import evidence_text, return_scale
from envs.tasks import Task

CANDIDATES = 1000  # points per plan
PUSH_HEIGHT = 0.01  # metres above the table, about the tip's


class Space:
    """The identity as a projection, for drawing in 3D."""

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Points [..., 3] metres, unchanged."""
        return np.asarray(points, dtype=np.float64)


def object_name(number: int) -> str:
    """Object 0 is the target."""
    return "target" if number == 0 else f"obstacle_{number}"


def vivid(color: Sequence[float]) -> list[int]:
    """Red, green, blue and perhaps opacity in [0, 1] -> whole numbers to 255."""
    return [round(255 * channel) for channel in color]


def log_plan(stream: rr.RecordingStream, record: PlanRecord, task: Task) -> None:
    """Log this plan in place of the last one, at the stream's current time."""
    for entity in ("world/plan", "world/reached"):
        stream.log(entity, rr.Clear(recursive=True))
    returns = record.plan.candidate_returns[0].numpy()
    scale = return_scale(returns)
    if scale is not None:
        points, values = candidate_subgoals(record, task, Space(), count=CANDIDATES)
        colors = np.asarray(RETURNS(scale(values)))[:, :3]
        dots = rr.Points3D(points, colors=(255 * colors).round().astype(np.uint8), radii=0.004)
        stream.log("world/plan/candidates", dots)
    for number, chain in subgoal_chains(record, Space()).items():
        color = SUBGOAL_COLOR if number == 0 else OBSTACLE_COLOR
        _log_paths(stream, "world/plan/subgoals", {number: chain}, color, radius=0.009)
    _log_paths(stream, "world/plan/predicted", predicted_paths(record, Space()), PREDICTION_COLOR, radius=0.005)
    ends = pushes(record, Space()) + np.array([0.0, 0.0, PUSH_HEIGHT])
    arrows = rr.Arrows3D(
        origins=ends[:, 0],
        vectors=ends[:, 1] - ends[:, 0],
        colors=vivid(to_rgb(PUSH_COLOR)),
        radii=0.003,
        labels=[str(number) for number in range(1, len(ends) + 1)],
    )
    stream.log("world/plan/pushes", arrows)
    expected = float(record.plan.expected_return[0])
    expectation = "" if np.isnan(expected) else f", expected return {expected:.0f}"
    about = f", {evidence_text(record.plan)}" if record.plan.evidence is not None else ""
    line = f"plan after {record.step} pushes, in {record.milliseconds:.0f} ms{expectation}{record.prospect}{about}"
    stream.log("log", rr.TextLog(line))


def log_reached(stream: rr.RecordingStream, record: PlanRecord, reached: NDArray[np.float32]) -> None:
    """Log the observed centres [n, M, 3] metres after the pushes so far."""
    _log_paths(stream, "world/reached", reached_paths(record, reached, Space()), REACHED_COLOR, radius=0.006)


def _log_paths(
    stream: rr.RecordingStream, entity: str, paths: Mapping[int, NDArray[np.float64]], color: str, *, radius: float
) -> None:
    """Lines with a ball at every point but the first, which is where the object is."""
    for number, path in paths.items():
        name = f"{entity}/{object_name(number)}"
        stream.log(name, rr.LineStrips3D([path], colors=vivid(to_rgb(color)), radii=radius / 3))
        stream.log(f"{name}/states", rr.Points3D(path[1:], colors=vivid(to_rgb(color)), radii=radius))
