"""The large maze of PointMaze: a force moves a ball to a place (`gymnasium-robotics`; D4RL, Fu et al. 2020).

Lengths are metres; a cell of the maze is 1 by 1.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.world import Goal, World, finite_numbers
from cavin_pyro.models.checks import check_choice, check_number
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

REPEAT = 10  # steps of the simulator, 0.01 s each, in one step of the environment
REACHED = 0.45  # metres from the goal, as published
PIXELS = 50  # of a metre in pictures
FORCE = 0.6  # metres in pictures, of the largest force

Cell = tuple[int, int]
Ways = dict[tuple[Cell, Cell], list[Cell]]


class Place(Goal):
    """The ball within `radius` of a place [2]; a sparse reward."""

    def __init__(self, space: Space, place: Any, radius: float) -> None:
        super().__init__(space)
        self._place, self._radius = [float(number) for number in place], radius

    def success(self, state: State) -> Tensor:
        return (state.centers[..., 0, :] - state.centers.new_tensor(self._place)).norm(dim=-1) < self._radius


class Maze(World):
    """Reach a place in the maze. One step here is ten of the simulator's, with the same force.

    Observation: place [2] and velocity [2]. Action: the force [2] in [-1, 1]. Walls are not observed: models learn
    them. Its state has one object, the ball, whose feature is the velocity. `info` of a reset: `goal` [2].

    Args:
        cells: of the shortest way from the start to the goal, at least.
        maximum_steps: after how many steps an episode is truncated; published, 80.
        margin: the part of 0.45 m within which a plan has to end.

    Raises ImportError: gymnasium-robotics is not installed. ValueError: an argument is not one of those above.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    space = Space(
        origin=(0.0, 0.0),
        length=4.0,
        step_range=0.6,
        action_sizes=(2,),
        center_scale=0.02,
        action_scales=(0.2,),
        unit_features=0,
        frequencies=5,
    )
    features, objects, names = 2, 1, ["ball"]
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = gymnasium.spaces.Box(-20.0, 20.0, (4,), np.float64)

    def __init__(
        self, *, cells: int = 10, maximum_steps: int = 80, margin: float = 0.8, render_mode: str | None = None
    ) -> None:
        check_number("maximum_steps", maximum_steps, 1, whole=True)
        check_number("cells", cells, 2, 20, whole=True)
        check_number("margin", margin, high=1, positive=True)
        check_choice("render_mode", render_mode, (None, "rgb_array"))
        try:
            from gymnasium_robotics.envs.maze import maps, point_maze
        except ImportError as error:
            line = f"the maze needs gymnasium-robotics ({error}): pip install -c constraints.txt -e '.[maze]'"
            raise ImportError(line) from error
        maze = maps.LARGE_MAZE
        self._simulator = point_maze.PointMazeEnv(maze_map=maze, continuing_task=False)
        self.ways = shortest_ways(np.array(maze) == 0)
        self._pairs = [pair for pair, way in self.ways.items() if len(way) >= cells]
        self._radius, self.maximum_steps, self.render_mode = margin * REACHED, maximum_steps, render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begin near the middle of a random cell, with a goal near that of another."""
        super().reset(seed=seed)
        cells = map(np.array, self._pairs[int(self.np_random.integers(len(self._pairs)))])
        chosen = dict(zip(("reset_cell", "goal_cell"), cells, strict=True))
        seen, _ = self._simulator.reset(seed=int(self.np_random.integers(2**31)), options=chosen)
        self._steps, self.place = 0, self._simulator.goal.copy()
        return seen["observation"], {"goal": self.place.copy()}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Push ten times, or until the goal is reached; an action that is not two finite numbers is a ValueError."""
        force = np.clip(finite_numbers("action", action, 2), -1.0, 1.0)
        for _ in range(REPEAT):
            seen = self._simulator.step(force)[0]["observation"]
            success = bool(np.linalg.norm(seen[:2] - self.place) < REACHED)
            if success:
                break
        self._steps += 1
        return seen, float(success), success, not success and self._steps >= self.maximum_steps, {"success": success}

    def state(self, observation: NDArray[np.float64]) -> State:
        place, velocity = torch.tensor(observation, dtype=torch.float32).split(2)
        return State(place[None], velocity[None], torch.ones(1, dtype=torch.bool))

    def goal(self, device: str | torch.device = "cpu") -> Place:
        return Place(self.space, self.place, self._radius)

    def policy(self, generator: np.random.Generator) -> Wanderer:
        return Wanderer(generator, self.ways, self._simulator.maze)

    def pixels(self, centers: NDArray[np.floating]) -> NDArray[np.float64]:
        maze = self._simulator.maze
        return PIXELS * (np.asarray(centers) * (1, -1) + (maze.x_map_center, maze.y_map_center))

    @property
    def landmarks(self) -> dict[str, NDArray[np.floating]]:
        return {"goal": self.place}

    def arrows(self, actions: NDArray[np.floating], centers: NDArray[np.floating]) -> NDArray[np.floating]:
        """See `World`: the force on the ball."""
        return np.stack([centers[:, 0], centers[:, 0] + FORCE * actions], axis=1)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw walls, goal and ball in mode rgb_array; the simulator's own pictures need OpenGL."""
        if self.render_mode is None:
            return None
        walls = np.kron(np.array(self._simulator.maze.maze_map), np.ones((PIXELS, PIXELS)))
        picture = np.where(walls == 1, 90, 245)[..., None].repeat(3, -1).astype(np.uint8)
        places = np.indices(walls.shape)[::-1].transpose(1, 2, 0)
        ball = self._simulator.point_env.data.qpos[:2]
        for place, radius, colour in ((self.place, REACHED, (120, 200, 120)), (ball, 0.15, (200, 60, 60))):
            picture[np.linalg.norm(places - self.pixels(place), axis=-1) < radius * PIXELS] = colour
        return picture

    def close(self) -> None:
        self._simulator.close()


class Wanderer:
    """Goes the shortest way to one random cell after another, and strays from it."""

    def __init__(self, generator: np.random.Generator, ways: Ways, maze: Any) -> None:
        self._generator, self._ways, self._maze = generator, ways, maze
        self._target, self._strays = (0, 0), generator.normal(size=2)

    def act(self, observation: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `cavin_pyro.envs.world.Policy`."""
        row, column = self._maze.cell_xy_to_rowcol(observation[:2])
        here = int(row), int(column)
        if (here, self._target) not in self._ways or self._generator.random() < 0.02:
            every = [goal for start, goal in self._ways if start == here]
            self._target = every[int(self._generator.integers(len(every)))]
        way = self._maze.cell_rowcol_to_xy(np.array(self._ways[here, self._target][1])) - observation[:2]
        self._strays = 0.8 * self._strays + 0.6 * self._generator.normal(size=2)
        return np.clip(4.0 * way - observation[2:] + 0.5 * self._strays, -1.0, 1.0)


def shortest_ways(free: NDArray[np.bool_]) -> Ways:
    """The cells from each free cell to each other, both ends included."""
    ways: Ways = {}
    for start in [(int(row), int(column)) for row, column in np.argwhere(free)]:
        known: dict[Cell, list[Cell]] = {start: [start]}
        for row, column in (queue := [start]):
            for after in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
                if free[after] and after not in known:
                    known[after] = [*known[row, column], after]
                    queue.append(after)
        ways |= {(start, goal): way for goal, way in known.items() if goal != start}
    return ways
