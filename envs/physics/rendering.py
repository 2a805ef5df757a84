"""Images of a world by PyBullet's software renderer."""

from __future__ import annotations

import numpy as np

from envs.physics.bullet import BulletClient, pybullet
from envs.sensors.camera import FAR, NEAR, Camera
from envs.sensors.sensor import Rendering


def render(bullet: BulletClient, camera: Camera) -> Rendering:
    """Depth, body numbers and colour as the camera sees them."""
    position, axes = np.array(camera.position), camera.axes
    # An intrinsic matrix written as the frustum that OpenGL's conventions want, column by column.
    along_row, along_column, column, row = camera.intrinsics
    width, height = camera.width, camera.height
    frustum = np.zeros((4, 4))
    frustum[0, 0], frustum[1, 1] = 2 * along_row / width, 2 * along_column / height
    frustum[0, 2], frustum[1, 2] = 1 - 2 * column / width, 2 * row / height - 1
    frustum[2, 2], frustum[2, 3] = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    frustum[3, 2] = -1.0
    image = bullet.getCameraImage(
        width,
        height,
        viewMatrix=pybullet.computeViewMatrix(position, position + position[2] * axes[2], -axes[1]),
        projectionMatrix=frustum.T.ravel().tolist(),
        renderer=pybullet.ER_TINY_RENDERER,
        shadow=0,
        lightDirection=(0.4, 0.3, 1.0),
    )
    buffer = np.asarray(image[3], dtype=np.float64).reshape(height, width)
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * buffer)
    bodies = np.asarray(image[4], dtype=np.int64).reshape(height, width)
    color = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)[..., :3]
    return Rendering(depth, bodies, color)
