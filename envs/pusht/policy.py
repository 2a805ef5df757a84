"""The T's outline, and the policy that collects pushes of it. Lengths are pixels of a window of 512."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

REACH = 100.0  # pixels; how far an action of 1 puts the disc's target, on each axis
SIZE, RADIUS = 512.0, 15.0  # pixels; of the window, and of the disc
WALLS = 8.0, 503.0  # pixels; within them nothing touches a wall
OUTLINE = np.array([(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)], dtype=float)
CENTER = np.array([0.0, 45.0])  # pixels in the block's frame; its centre of mass
SPACING = 5.0  # pixels between the points of the outline that the policy knows
ARRIVED = 6.0  # pixels from where a push begins
APPROACHES = 6  # steps on the way to a push, at most
ASTRAY = 0.1  # of the intents are random moves
MARGIN = 35.0  # pixels that pushes leave between block and wall, in which the disc can pass
CANDIDATES = 12  # pushes to choose one from
ROUND = 115.0  # pixels from the block's centre of mass, on the way round it
NOISE = 3.0  # pixels; standard deviation of a push's displacement, on each axis

ObservationDict = dict[str, NDArray[np.float64]]


class PushTPolicy:
    """Collects data: goes to a random point of the block's outline, pushes there in a line or a curve, and so on.

    `generator`: all of the policy's randomness.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self._approaches = self._pushes = self._moves = 0  # steps left of each kind
        self._contact, self._displacement = np.zeros((2, 2))  # in the block's frame; of the next push, in the window's
        self._turn = 0.0  # radians from one push to the next

    def act(self, observation: ObservationDict) -> NDArray[np.float64]:
        """Choose the next action [2] from an observation."""
        generator, agent, block = self._generator, observation["agent"], observation["block"]
        if self._pushes + self._moves == 0:
            self._choose(agent, block)
        if self._moves:
            self._moves -= 1
            return generator.uniform(-1.0, 1.0, size=2)
        start = in_window(block, self._contact)
        if self._approaches and np.linalg.norm(start - agent) > ARRIVED:
            self._approaches -= 1
            way = _way(agent, start, block) - agent
            return way / max(REACH, float(np.abs(way).max()))
        self._approaches = 0
        self._pushes -= 1
        action = (self._displacement + generator.normal(scale=NOISE, size=2)) / REACH
        self._displacement = self._displacement @ rotation(self._turn).T
        return np.clip(action, -1.0, 1.0)

    def _choose(self, agent: NDArray[np.float64], block: NDArray[np.float64]) -> None:
        """Choose random moves, or one of some pushes: mostly one that leaves the block inside, often a near one."""
        generator = self._generator
        if generator.random() < ASTRAY:
            self._moves = int(generator.integers(1, 4))
            return
        steps, length = int(generator.integers(1, 6)), generator.uniform(20.0, REACH)
        points, normals = SKIN
        chosen = generator.integers(len(points), size=CANDIDATES)
        gaps = RADIUS + generator.uniform(1.0, 15.0, size=(CANDIDATES, 1))
        contacts = points[chosen] + gaps * normals[chosen]
        starts, outline = in_window(block, contacts), in_window(block, points)
        inward = -normals[chosen] @ rotation(float(block[2])).T
        angles = np.arctan2(inward[:, 1], inward[:, 0]) + generator.normal(scale=0.5, size=CANDIDATES)
        headings = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        room = np.where(headings > 0, WALLS[1] - outline.max(axis=0), outline.min(axis=0) - WALLS[0]) - MARGIN
        room = (np.maximum(room, 0.0) / np.maximum(np.abs(headings), 1e-6)).min(axis=-1) + gaps[:, 0] - RADIUS
        reachable = ((starts > WALLS[0] + RADIUS) & (starts < WALLS[1] - RADIUS)).all(axis=-1)
        cost = np.linalg.norm(starts - agent, axis=-1) * generator.integers(2)
        cost += generator.uniform(0.0, 100.0, CANDIDATES) + 4 * SIZE * ~reachable
        cost += SIZE * (room < 100.0)
        length = np.minimum(length, room / steps)
        best = int(cost.argmin())
        self._contact = contacts[best]
        self._displacement = length[best] * headings[best]
        self._approaches, self._pushes, self._turn = APPROACHES, steps, float(generator.normal(scale=0.25))


def outline_of(state: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [P, 2] of the block's outline in a state [5 or more]."""
    return in_window(state[2:5], SKIN[0])


def in_window(block: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [..., 2] of the block's frame, in the window's, for a block [3] (x, y, angle)."""
    return points @ rotation(float(block[2])).T + block[:2]


def rotation(angle: float) -> NDArray[np.float64]:
    """The matrix [2, 2] that turns a vector by an angle in radians."""
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _way(agent: NDArray[np.float64], start: NDArray[np.float64], block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where to go next [2] from the disc to the start of a push: there, or round the block if it is in between."""
    line = start - agent
    outline = in_window(block, SKIN[0])
    along = np.clip((outline - agent) @ line / max(float(line @ line), 1e-9), 0.0, 1.0)
    if np.linalg.norm(agent + along[:, None] * line - outline, axis=-1).min() >= RADIUS - 2.0:
        return start
    center = in_window(block, CENTER)
    bearing, wanted = (math.atan2(*(point - center)[::-1]) for point in (agent, start))
    bearing += float(np.clip(math.remainder(wanted - bearing, 2 * math.pi), -1.0, 1.0))
    around = center + ROUND * np.array([math.cos(bearing), math.sin(bearing)])
    return np.clip(around, WALLS[0] + RADIUS, WALLS[1] - RADIUS)


def _skin() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points [P, 2] of the block's outline in its frame, and the outward normals there."""
    points, normals = [], []
    for begin, end in zip(OUTLINE, np.roll(OUTLINE, -1, axis=0), strict=True):
        edge = end - begin
        length = float(np.linalg.norm(edge))
        fractions = (np.arange(round(length / SPACING)) + 0.5) / round(length / SPACING)
        points.append(begin + fractions[:, None] * edge)
        normals.append(np.tile(np.array([edge[1], -edge[0]]) / length, (len(fractions), 1)))
    return np.concatenate(points), np.concatenate(normals)


SKIN = _skin()
