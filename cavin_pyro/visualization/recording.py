"""An episode in 3D on a timeline, for the rerun viewer: the world, the observations, and the plans.

Everything spatial is in metres in the robot's base frame. The plans have the same candidates, chains, pushes and
predictions as the pictures. `docs/how-to/see-a-plan.md` lists the entities.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.markings import PLACE_RADIUS
from cavin_pyro.envs.tabletop.pushing import ObservationDict, PushingEnv
from cavin_pyro.envs.tabletop.scene import COLORS
from cavin_pyro.envs.tabletop.tasks import Task
from cavin_pyro.envs.tabletop.workspace import TILE_SIDE, tile_center
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.evaluation.statistics import counted
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.overlay import (
    OBSTACLE_COLOR,
    PREDICTION_COLOR,
    PUSH_COLOR,
    REACHED_COLOR,
    SUBGOAL_COLOR,
    candidate_subgoals,
    object_paths,
    predicted_paths,
    pushes,
    subgoal_chains,
)
from cavin_pyro.visualization.plan import RETURNS, return_scale
from cavin_pyro.visualization.video import FRAMES_PER_SECOND, PAUSE

TIMELINE = "video"  # seconds; the same moments as in `episode.mp4`
POINT_RADIUS = 0.0015  # metres
TILE_HEIGHT = 0.001  # metres above the table, or the two would flicker
CANDIDATES = 1000  # points per plan
PUSH_HEIGHT = 0.01  # metres above the table, about the tip's


class Space:
    """The identity as a projection [..., 3] metres, for drawing in 3D."""

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(points, dtype=np.float64)


def object_name(number: int) -> str:
    """Object 0 is the target."""
    return "target" if number == 0 else f"obstacle_{number}"


def vivid(color: Sequence[float]) -> list[int]:
    """Red, green, blue and perhaps opacity in [0, 1] -> whole numbers to 255."""
    return [round(255 * channel) for channel in color]


class EpisodeRecording(EpisodeCallback):
    """Records an episode; made by `recording`."""

    def __init__(self, stream: rr.RecordingStream, env: PushingEnv, task: Task) -> None:
        self._stream, self._scene, self._task = stream, env.scene, task
        self._links: dict[tuple[int, int], str] = {}
        self._record: PlanRecord | None = None
        self._reached: list[NDArray[np.float32]] = []
        self._seconds = 0.0

    def on_observation(self, observation: ObservationDict) -> None:
        """Log poses and the observation."""
        self._stream.set_time(TIMELINE, duration=self._seconds)
        if not self._links:
            self._log_scene()
        self._log_poses()
        for number in np.flatnonzero(observation["mask"]):
            points = rr.Points3D(observation["clouds"][number], colors=vivid(COLORS[number]), radii=POINT_RADIUS)
            self._stream.log(f"world/observed/points/{object_name(number)}", points)
        centers = observation["centers"][observation["mask"].astype(np.bool_)]
        self._stream.log("world/observed/centers", rr.Points3D(centers, colors=(255, 255, 255), radii=0.006))
        if self._record is not None:
            self._reached.append(observation["centers"])
            paths = object_paths(self._record, np.array(self._reached), Space())
            self._log_paths("world/reached", paths, REACHED_COLOR, radius=0.006)

    def on_plan(self, record: PlanRecord) -> None:
        """Log the plan, and pause before it is executed."""
        self._record, self._reached = record, []
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_plan(record)
        self._log_photograph(record.photograph)
        self._seconds += PAUSE

    def on_frame(self) -> None:
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_poses()
        self._seconds += 1.0 / FRAMES_PER_SECOND

    def on_end(self, episode: Episode) -> None:
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_photograph(episode.photograph)
        made = counted(len(episode.transitions), "push", "pushes")
        level = rr.TextLogLevel.INFO if episode.outcome == "success" else rr.TextLogLevel.ERROR
        self._stream.log("log", rr.TextLog(f"{episode.outcome} after {made}", level=level))

    def _log_plan(self, record: PlanRecord) -> None:
        """Log this plan in place of the last one."""
        stream = self._stream
        for entity in ("world/plan", "world/reached"):
            stream.log(entity, rr.Clear(recursive=True))
        returns = record.plan.candidate_returns[0].numpy()
        scale = return_scale(returns)
        if scale is not None:
            points, values = candidate_subgoals(record, self._task, Space(), count=CANDIDATES)
            colors = np.asarray(RETURNS(scale(values)))[:, :3]
            dots = rr.Points3D(points, colors=(255 * colors).round().astype(np.uint8), radii=0.004)
            stream.log("world/plan/candidates", dots)
        for number, chain in subgoal_chains(record, Space()).items():
            color = SUBGOAL_COLOR if number == 0 else OBSTACLE_COLOR
            self._log_paths("world/plan/subgoals", {number: chain}, color, radius=0.009)
        self._log_paths("world/plan/predicted", predicted_paths(record, Space()), PREDICTION_COLOR, radius=0.005)
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
        made = counted(record.step, "push", "pushes")
        line = f"plan after {made}, in {record.milliseconds:.0f} ms{expectation}{record.prospect}"
        stream.log("log", rr.TextLog(line))

    def _log_paths(self, entity: str, paths: Mapping[int, NDArray[np.float64]], color: str, *, radius: float) -> None:
        """Lines with a ball at every point but the first, which is where the object is."""
        for number, path in paths.items():
            name = f"{entity}/{object_name(number)}"
            self._stream.log(name, rr.LineStrips3D([path], colors=vivid(to_rgb(color)), radii=radius / 3))
            self._stream.log(f"{name}/states", rr.Points3D(path[1:], colors=vivid(to_rgb(color)), radii=radius))

    def _log_photograph(self, photograph: NDArray[np.uint8] | None) -> None:
        if photograph is not None:
            self._stream.log("camera", rr.Image(photograph).compress(jpeg_quality=80))

    def _log_scene(self) -> None:
        """Log what does not change: shapes in their own frames, and the task's tiles."""
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for number, part in enumerate(self._scene.world.parts()):
            path = self._links.setdefault((part.body, part.link), self._link_path(part.body, part.link))
            corners = part.vertices[part.triangles]  # [F, 3, 3], each triangle with corners of its own: flat shading
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
            mesh = rr.Mesh3D(
                vertex_positions=corners.reshape(-1, 3).astype(np.float32),
                vertex_normals=normals.repeat(3, axis=0).astype(np.float32),
                albedo_factor=vivid(part.color),
            )
            self._stream.log(f"{path}/shape_{number}", mesh, static=True)
        for group in self._task.tile_groups():
            around = TILE_SIDE / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1], [-1, -1]])
            loops = [np.array(tile_center(tile)) + around for tile in group.tiles]
            self._log_loops(f"world/tiles/{group.name.replace(' ', '_')}", loops, to_rgb(group.color))
        angles = np.linspace(0.0, 2.0 * np.pi, 33)
        ring = PLACE_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
        for number, place in enumerate(self._task.object_places()):
            self._log_loops(f"world/places/{object_name(number)}", [np.array(place) + ring], COLORS[number])

    def _log_loops(self, entity: str, loops: Sequence[NDArray[np.float64]], color: Sequence[float]) -> None:
        """Lines [P, 2] metres on the table."""
        strips = [np.column_stack([loop, np.full(len(loop), TILE_HEIGHT)]) for loop in loops]
        self._stream.log(entity, rr.LineStrips3D(strips, colors=vivid(color), radii=0.002), static=True)

    def _link_path(self, body: int, link: int) -> str:
        if body in self._scene.bodies:
            return f"world/objects/{object_name(self._scene.bodies.index(body))}"
        if body < min(self._scene.bodies):
            return "world/table"  # the first body of the world
        return f"world/robot/body_{body}/{'base' if link < 0 else f'link_{link}'}"

    def _log_poses(self) -> None:
        poses = self._scene.world.link_poses(list(self._links))
        for path, position, orientation in zip(self._links.values(), *vars(poses).values(), strict=True):
            self._stream.log(path, rr.Transform3D(translation=position, quaternion=orientation))


@contextmanager
def recording(path: Path, env: PushingEnv, task: Task) -> Iterator[EpisodeRecording]:
    """Yield a recording of an episode; write it to the `.rrd` file at the end, atomically."""
    stream = rr.RecordingStream("cavin_pyro")
    written = stream.binary_stream()  # rerun's own file writer does not report a full disk
    stream.send_blueprint(_blueprint())
    try:
        yield EpisodeRecording(stream, env, task)
        content = written.read(flush=True)
    finally:
        stream.disconnect()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content or b"")


def _blueprint() -> rrb.Blueprint:
    beside = rrb.Vertical(rrb.Spatial2DView(origin="camera", name="camera"), rrb.TextLogView(origin="log", name="log"))
    table = rrb.Spatial3DView(origin="world", name="table")
    return rrb.Blueprint(rrb.Horizontal(table, beside, column_shares=[3, 1]), collapse_panels=True)
