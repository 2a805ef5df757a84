"""An episode in 3D on a timeline, for the rerun viewer: the world, what was seen of it, and the plans.

Everything spatial is in metres in the robot's base frame. `docs/seeing-a-plan.md` lists what is where.
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

from cavin_pyro.episodes import Decision, Episode
from cavin_pyro.files import replacing
from cavin_pyro.recording_plan import log_plan, log_reached, object_name, vivid
from cavin_pyro.video import FRAMES_PER_SECOND, PAUSE
from envs.appearance import parts_of
from envs.layouts import Layout
from envs.markings import tile_groups
from envs.pushing import ObservationDict, PushingEnv
from envs.scene import COLORS
from envs.workspace import TILE_SIDE, tile_center

TIMELINE = "video"  # seconds; the same moments as in `episode.mp4`
POINT_RADIUS = 0.0015  # metres
TILE_HEIGHT = 0.001  # metres above the table, or the two would flicker


class EpisodeRecording:
    """Writes what it is told of an episode; see `recording` for how to get one."""

    def __init__(self, stream: rr.RecordingStream, env: PushingEnv, layout: Layout) -> None:
        self._stream, self._scene, self._layout = stream, env.scene, layout
        self._links: dict[tuple[int, int], str] = {}
        self._decision: Decision | None = None
        self._reached: list[NDArray[np.float32]] = []
        self._seconds = 0.0

    def set_observation(self, observation: ObservationDict) -> None:
        """What the camera saw, at the beginning and after every push."""
        self._stream.set_time(TIMELINE, duration=self._seconds)
        if not self._links:
            self._log_scene()
        self._log_poses()
        for number in np.flatnonzero(observation["mask"]):
            points = rr.Points3D(observation["clouds"][number], colors=vivid(COLORS[number]), radii=POINT_RADIUS)
            self._stream.log(f"world/seen/points/{object_name(number)}", points)
        centers = observation["centers"][observation["mask"].astype(np.bool_)]
        self._stream.log("world/seen/centers", rr.Points3D(centers, colors=(255, 255, 255), radii=0.006))
        if self._decision is not None:
            self._reached.append(observation["centers"])
            log_reached(self._stream, self._decision, np.array(self._reached))

    def set_decision(self, decision: Decision) -> None:
        """What was considered and chosen; it stands for a moment before it is carried out."""
        self._decision, self._reached = decision, []
        self._stream.set_time(TIMELINE, duration=self._seconds)
        log_plan(self._stream, decision, self._layout)
        self._log_photograph(decision.photograph)
        self._seconds += PAUSE

    def add_frame(self) -> None:
        """Where everything is, a few times during every push."""
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_poses()
        self._seconds += 1.0 / FRAMES_PER_SECOND

    def end(self, episode: Episode) -> None:
        """How it went."""
        self._stream.set_time(TIMELINE, duration=self._seconds)
        self._log_photograph(episode.photograph)
        level = rr.TextLogLevel.INFO if episode.outcome == "success" else rr.TextLogLevel.ERROR
        self._stream.log("log", rr.TextLog(f"{episode.outcome} after {len(episode.pushes)} pushes", level=level))

    def _log_photograph(self, photograph: NDArray[np.uint8] | None) -> None:
        if photograph is not None:
            self._stream.log("camera", rr.Image(photograph).compress(jpeg_quality=80))

    def _log_scene(self) -> None:
        """What does not change: shapes in their own frames, and the task's tiles."""
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for number, part in enumerate(parts_of(self._scene.world)):
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
        for group in tile_groups(self._layout):
            loops = [np.array(tile_center(tile)) + around for tile in group.tiles]
            strips = [np.column_stack([loop, np.full(len(loop), TILE_HEIGHT)]) for loop in loops]
            lines = rr.LineStrips3D(strips, colors=vivid(to_rgb(group.color)), radii=0.002)
            self._stream.log(f"world/tiles/{group.name.replace(' ', '_')}", lines, static=True)

    def _link_path(self, body: int, link: int) -> str:
        if body in self._scene.bodies:
            return f"world/objects/{object_name(self._scene.bodies.index(body))}"
        if body < min(self._scene.bodies):
            return "world/table"  # the world begins with it
        return f"world/robot/body_{body}/{'base' if link < 0 else f'link_{link}'}"

    def _log_poses(self) -> None:
        poses = self._scene.world.link_poses(list(self._links))
        for path, position, orientation in zip(self._links.values(), *vars(poses).values(), strict=True):
            self._stream.log(path, rr.Transform3D(translation=position, quaternion=orientation))


@contextmanager
def recording(path: Path, env: PushingEnv, layout: Layout) -> Iterator[EpisodeRecording]:
    """A recording whose file `.rrd` takes its place at the end, or is not there if anything went wrong."""
    stream = rr.RecordingStream("cavin_pyro")
    written = stream.binary_stream()  # rerun's own writer of files does not tell when a disk is full
    stream.send_blueprint(_blueprint())
    try:
        yield EpisodeRecording(stream, env, layout)
        content = written.read(flush=True)
    finally:
        stream.disconnect()
    with replacing(path) as temporary:
        temporary.write_bytes(content or b"")


def _blueprint() -> rrb.Blueprint:
    beside = rrb.Vertical(rrb.Spatial2DView(origin="camera", name="camera"), rrb.TextLogView(origin="log", name="log"))
    table = rrb.Spatial3DView(origin="world", name="table")
    return rrb.Blueprint(rrb.Horizontal(table, beside, column_shares=[3, 1]), collapse_panels=True)
