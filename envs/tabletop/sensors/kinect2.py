"""A Kinect v2 above the table, with noise, missing pixels and errors of its pose.

Noise along and across the rays: Fankhauser, Bloesch, Rodriguez, Kaestner, Hutter and Siegwart, "Kinect v2 for mobile
robot navigation: evaluation and modeling", ICAR 2015. That a time-of-flight camera mixes foreground and background at
the edges of objects ("flying pixels"): Sarbolandi, Lefloch and Kolb, "Kinect range sensing: structured-light versus
time-of-flight Kinect", CVIU 2015; neither paper gives rates, so those below are ours. Perturbation of the viewpoint:
the published implementation's data collection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.tabletop.sensors.camera import KINECT2_HEIGHT, KINECT2_WIDTH, Camera
from cavin_pyro.envs.tabletop.sensors.sensor import DepthImage, Renderer
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW

LATERAL_NOISE = 0.0016  # metres across the ray, standard deviation
RANGE = (0.5, 4.5)  # metres; the sensor's working range
RESOLUTION = 0.001  # metres; depth comes as whole millimetres
EDGE_JUMP = 0.015  # metres between neighbouring pixels that count as an edge
EDGE_LOSS, EDGE_MIXING = 0.5, 0.25  # shares of an edge's pixels without a measurement, and with a mixed one
GRAZING = np.radians(78.0)  # angle between ray and surface's normal from which nothing comes back
NOTHING = 10.0  # metres; beyond the range: depth of rays that meet neither table nor object
LOSS = 0.001  # share of all pixels without a measurement

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Perturbation:
    """Uniform perturbation of a camera: largest deviations, either way.

    intrinsics: pixels, on both focal lengths and the principal point. translation: metres, on each axis.
    rotation: radians, about each axis.
    """

    intrinsics: float
    translation: float
    rotation: float

    def sample(self, camera: Camera, generator: np.random.Generator) -> Camera:
        """A camera near `camera`."""
        offsets = np.array(camera.intrinsics_offset) + generator.uniform(-self.intrinsics, self.intrinsics, 4)
        position = np.array(camera.position) + generator.uniform(-self.translation, self.translation, 3)
        turn = Rotation.from_rotvec(generator.uniform(-self.rotation, self.rotation, 3))
        rotation = (turn * Rotation.from_rotvec(camera.rotation)).as_rotvec()
        return replace(
            camera,
            position=tuple(position.tolist()),
            rotation=tuple(rotation.tolist()),
            intrinsics_offset=tuple(offsets.tolist()),
        )


NOMINAL = Camera(KINECT2_WIDTH, KINECT2_HEIGHT)
VIEWPOINT = Perturbation(intrinsics=15.0, translation=0.05, rotation=0.025)
CALIBRATION = Perturbation(intrinsics=0.5, translation=0.002, rotation=0.002)


@dataclass
class Kinect2:
    """The Kinect v2's depth camera.

    Attributes:
        nominal: the nominal pose.
        viewpoint: its perturbation in an episode. The program knows it, as in the published implementation:
            calibration finds it.
        calibration: the remaining error of the calibration: the difference of the true pose from the assumed one.
    """

    nominal: Camera = NOMINAL
    viewpoint: Perturbation = VIEWPOINT
    calibration: Perturbation = CALIBRATION

    def reset(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self.actual = self.viewpoint.sample(self.nominal, generator)
        self.believed = self.calibration.sample(self.actual, generator)
        # The table does not move, so one image of it serves an episode.
        self._table, incidence = _bare_table(self.actual)
        self._table_noise = axial_noise(self._table, incidence)

    def capture(self, render: Renderer) -> tuple[DepthImage, NDArray[np.int64]]:
        rendering = render(self.actual, table=False)
        drawn = (rendering.bodies >= 0) & (rendering.depth < self._table)
        depth = np.where(drawn, rendering.depth, self._table).astype(np.float32)
        return DepthImage(self._measure(depth, drawn), self.believed), np.where(drawn, rendering.bodies, -1)

    def _measure(self, depth: Image, objects: NDArray[np.bool_]) -> Image:
        """What the sensor returns for a true depth image; `objects` masks the pixels of objects."""
        generator, camera = self._generator, self.actual
        noise = generator.standard_normal(depth.shape, dtype=np.float32)
        measured = depth + noise * self._table_noise
        near = ndimage.binary_dilation(objects, iterations=2)
        rows, columns = np.nonzero(near)
        if len(rows):
            lateral = LATERAL_NOISE * camera.intrinsics[0] / np.clip(depth[rows, columns], *RANGE)  # pixels
            shift = np.rint(generator.standard_normal((2, len(rows)), dtype=np.float32) * lateral).astype(np.intp)
            from_rows = np.clip(rows + shift[0], 0, camera.height - 1)
            from_columns = np.clip(columns + shift[1], 0, camera.width - 1)
            distance = depth[from_rows, from_columns]
            lowest, highest, incidence = _surroundings(depth, from_rows, from_columns, camera)
            edge = highest - lowest > EDGE_JUMP
            fate = generator.random(len(rows), dtype=np.float32)
            share = generator.random(len(rows), dtype=np.float32)
            mixed = edge & (fate >= EDGE_LOSS) & (fate < EDGE_LOSS + EDGE_MIXING)
            # Beside an edge, the smaller of both angles is that of the surface.
            value = distance + noise[rows, columns] * axial_noise(distance, np.where(edge, 0.0, incidence))
            # Without a background, only the front is measured.
            behind = np.where(highest > RANGE[1], lowest, highest)
            value = np.where(mixed, lowest + share * (behind - lowest), value)
            value[(edge & (fate < EDGE_LOSS)) | (~edge & (incidence > GRAZING))] = 0.0
            measured[rows, columns] = value
        measured[generator.random(depth.shape, dtype=np.float32) < LOSS] = 0.0
        measured[(measured < RANGE[0]) | (measured > RANGE[1])] = 0.0
        return np.rint(measured / np.float32(RESOLUTION)) * np.float32(RESOLUTION)


def axial_noise(depth: NDArray[np.floating], incidence: NDArray[np.floating]) -> Image:
    """Standard deviation along the ray, metres, of a depth in metres seen at an angle in radians; any shape.

    Source: Fankhauser et al. 2015, the model without sunlight.
    """
    depth = np.clip(depth, *RANGE)
    angle = np.clip(incidence, 0.0, GRAZING)
    millimetres = 1.5 - 0.5 * depth + 0.3 * depth**2 + 0.1 * depth**1.5 * angle**2 / (np.pi / 2 - angle) ** 2
    return (1e-3 * millimetres).astype(np.float32)


def _bare_table(camera: Camera) -> tuple[Image, Image]:
    """Of the bare table, [height, width]: depth, `NOTHING` beside it, and angle between ray and normal, radians."""
    rays = camera.rays(*np.indices((camera.height, camera.width)).reshape(2, -1))
    directions = rays @ camera.axes
    with np.errstate(divide="ignore"):
        depth = -camera.position[2] / directions[:, 2]
    x, y = (camera.position[axis] + depth * directions[:, axis] for axis in (0, 1))
    on_table = (x >= TABLE_LOW[0]) & (x <= TABLE_HIGH[0]) & (y >= TABLE_LOW[1]) & (y <= TABLE_HIGH[1]) & (depth > 0)
    cosine = -(rays @ camera.axes[:, 2]) / np.linalg.norm(rays, axis=-1)
    images = np.where(on_table, depth, NOTHING), np.arccos(np.clip(cosine, 0.0, 1.0))
    depths, angles = (image.astype(np.float32).reshape(camera.height, camera.width) for image in images)
    return depths, angles


def _surroundings(
    depth: Image, rows: NDArray[np.intp], columns: NDArray[np.intp], camera: Camera
) -> tuple[Image, Image, Image]:
    """Least and largest depth among a pixel and its four neighbours, and the angle at which its surface is seen.

    Each [P]. The surface's slope is taken from the differences between the neighbours.
    """
    above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, camera.height - 1)
    left, right = np.maximum(columns - 1, 0), np.minimum(columns + 1, camera.width - 1)
    own = depth[rows, columns]
    around = np.stack([own, depth[above, columns], depth[below, columns], depth[rows, left], depth[rows, right]])
    lowest, highest = around.min(axis=0), around.max(axis=0)
    along_row, along_column, *_ = camera.intrinsics
    rays = camera.rays(rows, columns)
    slope_right = (around[4] - around[3]) / 2 * along_row / own
    slope_down = (around[2] - around[1]) / 2 * along_column / own
    # A surface z(u, v): its normal is (z_u f, z_v f, -(z + (u - c) z_u + (v - c) z_v)) up to length.
    ahead = 1.0 + rays[:, 0] * slope_right + rays[:, 1] * slope_down
    normal = np.stack([slope_right, slope_down, -ahead], axis=-1)
    cosine = -(normal * rays).sum(axis=-1) / (np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1))
    incidence = np.arccos(np.clip(cosine, 0.0, 1.0)).astype(np.float32)
    return lowest, highest, incidence
