"""The live view's page: `python -m cavin_pyro.plan viewer=live`, served by viser on this machine alone."""

from __future__ import annotations

import hmac
import io
import logging
import math
import secrets
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stdout, suppress
from typing import Any

import numpy as np
import trimesh
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from omegaconf import DictConfig

from cavin_pyro.config.composition import presets
from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.scene import COLORS
from cavin_pyro.envs.tabletop.workspace import TABLE_CENTER, TABLE_HIGH, TABLE_LOW, TILE_SIDE, tile_center
from cavin_pyro.evaluation.rollout import EpisodeCallback, PlanRecord
from cavin_pyro.visualization import drawing
from cavin_pyro.visualization.live import AS_GIVEN, LiveLoop

HOST = "127.0.0.1"
TABLE_COLOR = "#C2B9AD"
GIZMO = 0.15  # metres; size of the arrows that move a goal
RAISED, THICK = 0.012, 0.005  # metres; of lines, above the table so that they are not hidden in it
TOOL = 0.30  # metres; length of what stands for the robot's tool


def serve(config: DictConfig) -> None:
    """Serve the page, print its address, and plan until Ctrl-C."""
    token = secrets.token_urlsafe(16)
    with server_behind(token, config.port) as server:
        loop = LiveLoop(config)
        page = Page(server, loop)
        print(f"http://{HOST}:{server.get_port()}/{token}/ (Ctrl-C ends)", flush=True)
        with closing(loop.world), suppress(KeyboardInterrupt):
            loop.run(page)


@contextmanager
def server_behind(token: str, port: int) -> Iterator[Any]:
    """A viser server on loopback that answers requests and websockets under /token/ alone, and 403 to all others.

    viser has no authentication: our check precedes its own function that websockets calls for every request. Where the
    port is busy it takes another. A `UserError`: viser is not installed.
    """
    try:
        import viser
        from websockets.asyncio import server as sockets
    except ImportError as error:
        raise UserError(f"viewer=live needs viser ({error}): pip install -c constraints.txt -e '.[live]'") from error
    usual, checks = sockets.serve, []

    def serve_checked(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            first, _, rest = request.path.partition("?")[0].lstrip("/").partition("/")
            if not hmac.compare_digest(first.encode(), token.encode()):
                return connection.respond(403, "Open the whole address that the command has printed.\n")
            request.path = f"/{rest}"
            return process_request(connection, request)

        checks.append(check)
        return usual(*arguments, process_request=check, **options)

    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # browsers open connections and do not use them
    sockets.serve = serve_checked
    try:
        with redirect_stdout(io.StringIO()):  # it prints an address without the token
            server = viser.ViserServer(host=HOST, port=port, label="cavin_pyro", verbose=False)
    finally:
        sockets.serve = usual
    try:
        if not checks:
            raise RuntimeError("this version of viser serves in another way, without the check of the token")
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


class Page(EpisodeCallback):
    """Draws the loop's world and plans with viser, and asks the loop for what is changed on the page.

    The tabletop is drawn in metres; other worlds as their picture, which lies on the floor and is 1 wide.
    """

    def __init__(self, server: Any, loop: LiveLoop) -> None:
        self.scene, self.loop, self.world = server.scene, loop, loop.world
        self._table = self.world if isinstance(self.world, PushingEnv) else None
        if self._table is None and self.world.pixels(np.zeros(2)) is None:
            raise UserError(f"viewer=live needs a world with pictures, which {self.world.name} has not")
        self._seed: int | None = None  # of the scene that is drawn
        middle, back = ((*TABLE_CENTER, 0.0), (0.5, 0.0, 0.75)) if self._table else ((0.0, 0.0, 0.0), (0.0, -0.5, 0.85))
        server.initial_camera.position, server.initial_camera.look_at = np.add(middle, back), middle
        self.scene.configure_default_lights(cast_shadow=False)  # a good part of the work without a graphics card
        self._controls(server.gui)
        loop.say = self.say

    def _controls(self, gui: Any) -> None:
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        loop, plans = self.loop, {"Run": math.inf, "Step": 1, "Pause": 0}
        self._text = gui.add_markdown("")
        buttons = gui.add_button_group("Plans", tuple(plans))
        buttons.on_click(lambda _: loop.ask(plans=plans[buttons.value]))
        gui.add_button("Next scene").on_click(lambda _: loop.ask(scene=loop.seed + 1))
        usual = int(loop.config.planner.get("samples", 1024))
        samples = gui.add_slider("Samples", 1, max(2048, usual), 1, usual)
        samples.on_update(lambda _: loop.ask(samples=samples.value))
        self._planner = gui.add_dropdown("Planner", (AS_GIVEN, *presets("planner")))
        self._planner.on_update(lambda event: loop.ask(planner=self._planner.value) if event.client else None)
        kinds = {"candidates (click one)": drawing.CANDIDATE, "subgoals": drawing.SUBGOALS}
        kinds |= {"predicted": drawing.PREDICTED, "reached": drawing.REACHED}
        legend = (f'<span style="color:{style["color"]}">■</span> {name}' for name, style in kinds.items())
        gui.add_markdown("  \n".join(legend))
        self._depth = gui.add_image(np.zeros((4, 4, 3), np.uint8), label="Depth", visible=self._table is not None)

    def say(self, line: str) -> None:
        """Show a line on the page; a goal or a planner that was refused returns to what it is."""
        runs = "running" if self.loop.plans >= 1 else "paused"
        self._text.content = f"**{self.world.name}, scene {self.loop.seed}, {runs}**  \n{line}"
        self._planner.value = self.loop.chosen
        self._place_goals()

    def on_observation(self, observation: Any) -> None:
        """Draw the scene, and what has been reached."""
        if self._seed != self.loop.seed:
            self._begin()
        centers, mask = self.world.positions(observation)
        self._reached.append(centers)
        self._lines("reached", np.array(self._reached), mask, drawing.REACHED)
        if self._table is not None:
            depth = self._table.scene.image.depth
            shades = colormaps["gray_r"]((depth - float(np.median(depth)) + 0.15) / 0.18)  # from 15 cm above the table
            self._depth.image = (255 * shades[..., :3]).astype(np.uint8)
        self.on_frame()

    def on_frame(self) -> None:
        """Move what moves."""
        if self._table is None:
            picture = self.world.render()
            self.scene.add_image("/floor", picture, 1.0, len(picture) / len(picture[0]), wxyz=(0.0, 1.0, 0.0, 0.0))
            return
        poses = self._table.scene.ground_truth()
        for body, place, turn in zip(self._bodies, poses.positions, poses.orientations, strict=True):
            body.position, body.wxyz = place, turn[[3, 0, 1, 2]]
        self._tool.position = self._table.scene.robot.tip() + np.array([0.0, 0.0, TOOL / 2])

    def on_plan(self, record: PlanRecord) -> None:
        """Draw candidates, of which a click shows one's imagined future, the chosen subgoals, and the prediction."""
        plan, segments, T = record.plan, int(record.plan.segments[0]), record.plan.actions.shape[1]

        def draw(name: str, ahead: NDArray[np.floating], style: drawing.Style) -> None:  # from now through [n, M, P]
            objects = ahead.shape[1]
            ways = np.concatenate([record.centers[None, :objects], ahead])
            self._lines(name, ways, record.mask[:objects], style)

        draw("subgoals", plan.subgoals.centers[0, :segments].numpy(), drawing.SUBGOALS)
        draw("predicted", plan.predicted_centers[0, : segments * T].numpy(), drawing.PREDICTED)
        self.scene.remove_by_name("/imagined")
        self.scene.remove_by_name("/candidates")
        centers = plan.candidate_centers[0].numpy()  # [N, K, M, P]; of some planners the target alone
        ends = centers[:, -1, 0] if centers.size else np.zeros((0, 2))  # some planners predict nothing
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(np.isfinite(ends).all(-1)))[: drawing.CANDIDATES]

        def imagine(click: Any) -> None:
            number = int(chosen[click.instance_index])
            draw("imagined", centers[number], drawing.CANDIDATE)
            self.say(f"a candidate's imagined future: return {float(plan.candidate_returns[0, number]):.1f}")

        if len(chosen):
            ball, turns = trimesh.creation.icosphere(1, 0.006), np.tile([1.0, 0.0, 0.0, 0.0], (len(chosen), 1))
            style = {"batched_colors": rgb(drawing.CANDIDATE["color"]), "opacity": 0.35, "cast_shadow": False}
            shape = (np.array(ball.vertices), np.array(ball.faces), turns, self.points(ends[chosen]))
            self.scene.add_batched_meshes_simple("/candidates", *shape, **style).on_click(imagine)
        self.say(f"planned{record.prospect}")

    def points(self, positions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Points [..., 3] of the drawing, for positions [..., P]."""
        if self._table is not None:
            return np.asarray(positions, dtype=np.float64)
        pixels, (height, width) = np.asarray(self.world.pixels(positions)), self._size
        return np.insert((pixels - (width / 2, height / 2)) / (width, -width), 2, 0.0, axis=-1)

    def _moved(self, event: Any) -> None:
        """Ask for the goals to be where the arrows are, in the world's units; `event`: a drag's."""
        corners = self.points(np.eye(3)[[2, 0, 1], : 3 if self._table else 2])[:, :2]
        units = (corners[1:] - corners[0]).T
        if event.phase == "end":
            places = np.array([gizmo.position[:2] for gizmo in self.gizmos]) - corners[0]
            angles = np.array([2 * math.atan2(gizmo.wxyz[3], gizmo.wxyz[0]) for gizmo in self.gizmos])
            goals = np.column_stack([np.linalg.solve(units, places.T).T, np.sign(np.linalg.det(units)) * angles])
            self.loop.ask(goals=goals[:, : self.world.goals().shape[1]])

    def _begin(self) -> None:
        """Draw a new scene."""
        self.scene.reset()
        self._seed, self._reached, goals = self.loop.seed, list[Any](), self.world.goals()
        if self._table is not None:
            size = (*np.subtract(TABLE_HIGH, TABLE_LOW), 0.02)
            self.scene.add_box("/table", rgb(TABLE_COLOR), size, position=(*TABLE_CENTER, -0.011))
            self._tool = self.scene.add_cylinder("/tool", radius=0.01, height=TOOL, color=(50, 50, 55))
            self._bodies = []
            for number, one in enumerate(self._table.scene.objects):
                mesh: Any = trimesh.load_mesh(self._table.scene.object_set.asset(one.name).visual)
                shape, color = (one.scale * np.array(mesh.vertices), np.array(mesh.faces)), COLORS[number % len(COLORS)]
                self._bodies.append(self.scene.add_mesh_simple(f"/object{number}", *shape, color=color))
        else:
            self._size = self.world.render().shape[:2]
        arrows = {"active_axes": (True, True, False), "disable_rotations": goals.shape[1] < 3, "depth_test": False}
        self.gizmos = [self.scene.add_transform_controls(f"/goal{n}", GIZMO, **arrows) for n in range(len(goals))]
        for gizmo in self.gizmos:
            gizmo.on_update(self._moved)
        self._place_goals()

    def _place_goals(self) -> None:
        """Put tiles and arrows where the goals are; other worlds show them in their pictures."""
        self.scene.remove_by_name("/tiles")
        if self._table is None and self.gizmos:
            self.on_frame()
        for height, group in enumerate(self._table.task.tile_groups() if self._table is not None else (), 1):
            for i, j in group.tiles:
                style = {"opacity": group.opacity, "position": (*tile_center((i, j)), 0.0005 * height)}
                size = (TILE_SIDE - 0.006, TILE_SIDE - 0.006, 0.001)
                self.scene.add_box(f"/tiles/{height}-{i}-{j}", rgb(group.color), size, **style)
        for gizmo, goal in zip(self.gizmos, self.world.goals(), strict=True):
            gizmo.position = (*self.points(goal[:2])[:2], RAISED)
            if len(goal) == 3:
                gizmo.wxyz = (math.cos(goal[2] / 2), 0.0, 0.0, -math.sin(goal[2] / 2))

    def _lines(self, name: str, ways: Any, mask: NDArray[np.bool_], style: drawing.Style) -> None:
        """Draw the paths [n, M, P] of real objects, but of tools, a little above the table."""
        shown = mask & np.isin(np.arange(len(mask)), drawing.named(self.world))
        ways = self.points(ways[:, shown])
        pieces = np.stack([ways[:-1], ways[1:]], 2).reshape(-1, 2, 3) + (0.0, 0.0, RAISED)
        pieces = pieces[np.isfinite(pieces).all((1, 2))]
        if len(pieces):
            self.scene.add_line_segments(f"/{name}", pieces, rgb(style["color"]), thickness=THICK)
        else:
            self.scene.remove_by_name(f"/{name}")


def rgb(color: str) -> tuple[int, ...]:
    """Of a colour's name, from 0 to 255."""
    return tuple(round(255 * part) for part in to_rgb(color))
