"""The live view: the goal is moved between plans, by the loop alone and by the mouse in a browser."""

from __future__ import annotations

import io
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from PIL import Image

from cavin_pyro.config.composition import compose
from cavin_pyro.envs.tabletop.workspace import tile_center
from cavin_pyro.evaluation.rollout import EpisodeCallback, PlanRecord
from cavin_pyro.visualization.live import LiveLoop
from tests.cavin_pyro.visualization.browser import CHROMIUM, opened

NEW = np.array(tile_center((0, 5)))  # the end of another arm of the bridge


class Stop(Exception):  # noqa: N818
    """Ends a loop."""


class Ends(EpisodeCallback):
    """Where plans end: the target's distance to NEW. After the first, asks for `changes`; after the second, stops."""

    def __init__(self, loop: LiveLoop, **changes: object) -> None:
        self.loop, self.changes, self.ends = loop, changes, []

    def on_plan(self, record: PlanRecord) -> None:
        self.plan = record.plan
        last = record.plan.subgoals.centers[0, int(record.plan.segments[0]) - 1, 0, :2].numpy()
        self.ends.append(float(np.linalg.norm(last - NEW)))
        if len(self.ends) == 2:
            raise Stop
        self.loop.ask(**self.changes)


@pytest.fixture
def loop():
    loop = LiveLoop(compose("plan", task="crossing", seed=1, planner={"samples": 64}), plans=np.inf)
    yield loop
    loop.world.close()


@pytest.mark.parametrize(("changes", "nearer"), [({"goals": [NEW]}, True), ({"samples": 48}, False)])
def test_the_next_plan_goes_to_where_the_goal_is(loop, changes, nearer):
    ends = Ends(loop, **changes)
    with pytest.raises(Stop):
        loop.run(ends)
    assert (ends.ends[1] < ends.ends[0] - 0.15) == nearer


def test_what_cannot_be_is_refused_in_a_line_and_changes_nothing(loop, capsys):
    before = loop.world.reset(seed=1) and loop.world.goals()
    loop.ask(goals=[tile_center((4, 6))], planner="sectar")
    assert loop._take() == set()
    assert "off the bridge" in (said := capsys.readouterr().out) and "Sectar" in said
    np.testing.assert_array_equal(loop.world.goals(), before)
    loop.ask(planner="mpc", samples=32)
    assert loop._take() == {"planner", "samples"}
    assert type(loop.planner).__name__ == "MpcPlanner" and loop.config.planner.samples == 32


def test_the_page_answers_to_its_token_alone():
    page = pytest.importorskip("cavin_pyro.visualization.live_page")
    pytest.importorskip("viser")
    with page.server_behind("token", 0) as server:
        address = f"http://127.0.0.1:{server.get_port()}"
        assert urllib.request.urlopen(f"{address}/token/").status == 200
        for wrong in ("/", "/wrong/", "/token2/"):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(address + wrong)


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_goal_is_dragged_in_a_browser_and_the_next_plan_goes_there(loop, tmp_path):
    pytest.importorskip("viser")
    from viser.transforms import SO3

    from cavin_pyro.visualization.live_page import GIZMO, Page, server_behind

    loop.plans, ends, colors = 0, Ends(loop), []

    def pixel(point):
        camera = next(iter(server.get_clients().values())).camera
        x, y, ahead = SO3(np.array(camera.wxyz)).as_matrix().T @ (point - camera.position)
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        return camera.image_width / 2 + focal * x / ahead, camera.image_height / 2 + focal * y / ahead

    def until(condition, act=lambda: None):
        end = time.monotonic() + 60
        while not condition() and time.monotonic() < end:
            act()
            time.sleep(0.2)

    def drag():
        start = np.array(page.gizmos[0].position) + 0.2 * GIZMO * np.array([1.0, 1.0, 0.0])
        tab.drag(pixel(start), pixel(start + [*(NEW - loop.world.goals()[0]), 0.0]))

    def click():
        colors.append(len(Image.open(io.BytesIO(tab.picture())).crop((0, 0, 400, 300)).getcolors(10**6)))
        shown = np.random.default_rng(0).permutation(64)[len(colors)]
        tab.drag(pixel(ends.plan.candidate_centers[0, shown, -1, 0].numpy()))

    def visit():
        try:
            until(server.get_clients)
            loop.ask(plans=1)
            until(lambda: ends.ends)
            until(lambda: "/imagined" in page.scene._handle_from_node_name, click)
            until(lambda: np.abs(loop.world.goals()[0] - NEW).max() < 0.01, drag)
        finally:
            loop.ask(plans=np.inf)

    with server_behind("token", 0) as server, opened(f"http://127.0.0.1:{server.get_port()}/token/", tmp_path) as tab:
        page = Page(server, loop)
        visitor = threading.Thread(target=visit)
        visitor.start()
        with pytest.raises(Stop):
            loop.run(page, ends)
        visitor.join()
        assert "/imagined" not in page.scene._handle_from_node_name  # it went with the plan it was of
    assert max(colors) > 100  # a scene, not a blank canvas
    assert ends.ends[1] < ends.ends[0] - 0.15
