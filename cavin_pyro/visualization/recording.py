"""An episode in 3D on a timeline, for the rerun viewer: the world, the observations, and the plans.

Everything spatial is in metres in the robot's base frame. `docs/how-to/see-a-plan.md` lists the entities.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.recording_plan import log_plan, log_reached, object_name, vivid
from cavin_pyro.visualization.video import FRAMES_PER_SECOND, PAUSE
from envs.markings import PLACE_RADIUS
from envs.pushing import ObservationDict, PushingEnv
from envs.scene import COLORS
from envs.tasks import Task
from envs.workspace import TILE_SIDE, tile_center

TIMELINE = "video"  # seconds; the same moments as in `episode.mp4`
POINT_RADIUS = 0.0015  # metres
TILE_HEIGHT = 0.001  # metres above the table, or the two would flicker


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
            log_reached(self._stream, self._record, np.array(self._reached))

    def on_plan(self, record: PlanRecord) -> None:
        """Log the plan, and pause before it is executed."""
        self._record, self._reached = record, []
        self._stream.set_time(TIMELINE, duration=self._seconds)
        log_plan(self._stream, record, self._task)
        self._log_photograph(record.photograph)
        self._seconds += PAUSE

    def on_frame(self) -> None:
        """Log poses."""
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_poses()
        self._seconds += 1.0 / FRAMES_PER_SECOND

    def on_end(self, episode: Episode) -> None:
        """Log the outcome."""
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_photograph(episode.photograph)
        level = rr.TextLogLevel.INFO if episode.outcome == "success" else rr.TextLogLevel.ERROR
        self._stream.log("log", rr.TextLog(f"{episode.outcome} after {len(episode.transitions)} pushes", level=level))

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
        around = TILE_SIDE / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1], [-1, -1]])
        for group in self._task.tile_groups():
            loops = [np.array(tile_center(tile)) + around for tile in group.tiles]
            strips = [np.column_stack([loop, np.full(len(loop), TILE_HEIGHT)]) for loop in loops]
            lines = rr.LineStrips3D(strips, colors=vivid(to_rgb(group.color)), radii=0.002)
            self._stream.log(f"world/tiles/{group.name.replace(' ', '_')}", lines, static=True)
        for number, place in enumerate(self._task.object_places()):
            angles = np.linspace(0.0, 2.0 * np.pi, 33)
            ring = np.array(place) + PLACE_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
            strip = np.column_stack([ring, np.full(len(ring), TILE_HEIGHT)])
            lines = rr.LineStrips3D([strip], colors=vivid(COLORS[number]), radii=0.002)
            self._stream.log(f"world/places/{object_name(number)}", lines, static=True)

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
