"""Do the arms push like the stick? `python benchmarks/robots.py [--pushes 500] [--assets DIR] [--json FILE]`.

The same pushes from the same poses under every robot, once with light objects and once with the published 10 kg: how
far the tip leaves its line, how far apart the objects end, and where the CPU time goes. Beside the robots, to tell what
such distances mean: the stick again, and the stick carried half a millimetre beside the line.

`--draw DIR` draws the deviations, and the arms at work; `--read FILES` takes the figures from what `--json` wrote.
`python benchmarks/world.py --robot sawyer` is the test of endurance.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from robots_pictures import draw_deviations, photograph_arms
from scipy.spatial.transform import Rotation

from envs.objects.sampling import ObjectParameters, ObjectRanges, sample_objects
from envs.physics import Poses
from envs.policy import HeuristicPushingPolicy
from envs.scene import FALLEN, Scene
from envs.workspace import normalised_push, push_endpoints

OBJECTS, PUSHES_PER_SCENE = 4, 5
AREA = [((0.40, -0.35), (0.70, 0.35))]
MOVED = 0.005  # metres; objects that stay are where they were under any robot
TOPPLED = 0.5  # radians by which an object's vertical leaves the vertical
ASIDE = 0.0005  # metres
PERCENTILES = (50, 75, 95, 99, 100)


class Watched:
    """A robot whose every verb is timed, and whose tip is followed while it slides."""

    def __init__(self, robot: Any, scene: Scene, seconds: dict[str, float]) -> None:
        self._robot, self._scene, self._seconds = robot, scene, seconds
        self.tips: list[np.ndarray] = []

    def __getattr__(self, verb: str) -> Any:
        done = getattr(self._robot, verb)

        def timed(*arguments: Any) -> Any:
            if verb == "slide":
                self.tips = []
                self._scene.world.on_step = lambda: self.tips.append(self._robot.tip())
            began = time.process_time()
            result = done(*arguments)
            self._seconds[self._phase(verb, *arguments)] += time.process_time() - began
            self._scene.world.on_step = None
            return result

        return timed

    def _phase(self, verb: str, *arguments: Any) -> str:
        if verb != "move":
            return {"slide": "push", "leave": "off stage", "reaches": "inverse kinematics", "wait": "settle"}.get(
                verb, "the rest"
            )
        return "up" if self.tips else "above" if arguments[0][2] > 0.1 else "down"


def scenes(count: int, heavy: bool, seed: int) -> list[tuple[list[ObjectParameters], np.random.Generator]]:
    sampled = []
    for number in range(count):
        generator, points = np.random.default_rng([seed, number]).spawn(2)
        objects = sample_objects([AREA] * OBJECTS, ObjectRanges(clearance=0.12), generator)
        sampled.append(([replace(one, mass=10.0, friction=0.8) for one in objects] if heavy else objects, points))
    return sampled


def pushes(
    robot: str, assets: Path | None, count: int, heavy: bool, script: list[Any] | None, aside: float = 0.0
) -> dict[str, Any]:
    """Make pushes; without a script the policy chooses them, with one they are taken from it, `aside` metres left."""
    scene = Scene(robot=robot, assets=assets)
    seconds: dict[str, float] = defaultdict(float)
    found: dict[str, Any] = {"script": [], "names": [], "after": [], "ended": [], "line": [], "end": []}
    for number, (objects, points) in enumerate(scenes(-(-count // PUSHES_PER_SCENE), heavy, seed=5)):
        observation = scene.reset(objects, points)
        policy = HeuristicPushingPolicy(np.random.default_rng(number))
        watched = Watched(scene.robot, scene, seconds)
        scene.robot = watched
        for turn in range(PUSHES_PER_SCENE):
            if script is None:
                before, action = scene.ground_truth(), policy.act(observation)
                found["script"].append((before, action))
            else:
                before, action = script[number * PUSHES_PER_SCENE + turn]
            scene.world.restore(scene.bodies, before)  # every robot pushes from the same place
            watched.tips = []
            report = scene.push(beside(action, aside) if aside else action)
            found["after"].append(scene.ground_truth())
            found["names"].append([one.name for one in scene.objects])
            found["ended"].append("unsafe" if report.unsafe else report.stopped)
            if watched.tips and not report.stopped:
                deviation, last = line(np.array(watched.tips), action)
                found["line"].append(deviation)
                found["end"].append(last)
            observation = scene.observe() if script is None else observation
    scene.close()
    return {**found, "seconds": seconds}


def beside(action: np.ndarray, aside: float) -> np.ndarray:
    """The same push on a parallel line, `aside` metres to the left of its own."""
    start, end = push_endpoints(action)
    motion = end - start
    left = np.array([-motion[1], motion[0]]) / max(float(np.linalg.norm(motion)), 1e-9)
    return normalised_push(start + aside * left, motion)


def line(tips: np.ndarray, action: np.ndarray) -> tuple[float, float]:
    """How far the tip was from its line at most, and from the line's end at last: metres."""
    start, end = push_endpoints(action)
    way = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    across = (tips[:, :2] - start) @ np.array([-way[1], way[0]])
    return float(np.abs(across).max()), float(np.linalg.norm(tips[-1, :2] - end))


def compare(reference: dict[str, Any], other: dict[str, Any]) -> list[dict[str, Any]]:
    """How the ends of objects differ between two robots, for every object that either moved.

    Returns:
        `apart`, `farther` along the push and `left` of it: metres, from the reference's end to the other's. `moved`:
        metres, by the reference. `toppled`: by either, about a horizontal axis. `name`, and the `push`'s number.
    """
    found = []
    for number, (before, action) in enumerate(reference["script"]):
        one, two = reference["after"][number], other["after"][number]
        start, end = push_endpoints(action)
        way = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        moved = [np.linalg.norm(after.positions - before.positions, axis=1) for after in (one, two)]
        on_table = np.stack([poses.positions[:, 2] for poses in (before, one, two)]).min(axis=0) > FALLEN
        for index in np.flatnonzero((np.maximum(*moved) > MOVED) & on_table):
            if reference["ended"][number] or other["ended"][number]:
                continue
            apart = two.positions[index] - one.positions[index]
            found.append(
                {
                    "apart": float(np.linalg.norm(apart)),
                    "farther": float(apart[:2] @ way),
                    "left": float(apart[:2] @ (-way[1], way[0])),
                    "moved": float(moved[0][index]),
                    "toppled": max(tilt(before, after, index) for after in (one, two)) > TOPPLED,
                    "name": reference["names"][number][index],
                    "push": number,
                }
            )
    return found


def tilt(before: Poses, after: Poses, index: int) -> float:
    """Radians by which an object's vertical left the vertical."""
    turn = Rotation.from_quat(after.orientations[index]) * Rotation.from_quat(before.orientations[index]).inv()
    return float(np.arccos(np.clip(turn.as_matrix()[2, 2], -1.0, 1.0)))


def millimetres(values: Any) -> str:
    if not len(values):
        return "none"
    return " / ".join(f"{1e3 * value:.2f}" for value in np.percentile(values, PERCENTILES))


def measure(robots: list[str], assets: Path | None, count: int, weights: list[str]) -> dict[str, Any]:
    results = {}
    for weight in weights:
        heavy = weight == "heavy"
        stick = pushes("stick", assets, count, heavy, None)
        print(f"{weight} objects, {len(stick['ended'])} pushes; millimetres at {PERCENTILES} %")
        # The same pushes again: what is left between two runs of one robot is the scenes' own doing.
        others = [("stick", "stick", 0.0), ("stick, beside", "stick", ASIDE), *((name, name, 0.0) for name in robots)]
        for title, robot, aside in others:
            found = pushes(robot, assets, count, heavy, stick["script"], aside)
            rows, done = compare(stick, found), len(found["line"])
            print(f"  {title}: ended {dict(Counter(found['ended']))}")
            print(f"    tip off its line {millimetres(found['line'])}, off its end {millimetres(found['end'])}")
            for chosen, which in (("all", (True, False)), ("not toppled", (False,)), ("toppled", (True,))):
                apart = [row["apart"] for row in rows if row["toppled"] in which]
                print(f"    {len(apart)} moved objects ({chosen}) end this far from the stick's: {millimetres(apart)}")
            split = ", ".join(f"{phase} {1e3 * time / done:.1f}" for phase, time in found["seconds"].items())
            print(f"    CPU ms per push: {1e3 * sum(found['seconds'].values()) / done:.1f} ({split})", flush=True)
            results[f"{weight}, {title}"] = {
                "objects": rows,
                **{key: found[key] for key in ("line", "end", "ended", "seconds")},
            }
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pushes", type=int, default=500)
    parser.add_argument("--robots", nargs="*", default=["sawyer", "panda"])
    parser.add_argument("--weights", nargs="+", default=["light", "heavy"], choices=["light", "heavy"])
    parser.add_argument("--assets", type=Path, default=Path("../shared/assets"))
    parser.add_argument("--json", type=Path, help="where the single deviations are written")
    parser.add_argument("--read", type=Path, nargs="+", help="draw what earlier runs wrote instead of measuring")
    parser.add_argument("--draw", type=Path, help="folder for pictures of the deviations and of the arms")
    arguments = parser.parse_args()
    if arguments.read:
        results = {name: one for path in arguments.read for name, one in json.loads(path.read_text()).items()}
    else:
        results = measure(arguments.robots, arguments.assets, arguments.pushes, arguments.weights)
    if arguments.draw:
        draw_deviations(arguments.draw / "robots-deviations.png", results)
        photograph_arms(arguments.draw / "robots.png", arguments.robots, arguments.assets)
    if arguments.json:
        arguments.json.write_text(json.dumps(results))


if __name__ == "__main__":
    main()
