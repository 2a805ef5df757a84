"""Do the arms push like the stick? `python benchmarks/robots.py [--pushes 500] [--assets DIR] [--soak N]`.

The same pushes from the same poses under every robot, once with light objects and once with the published 10 kg: how
far the tip leaves its line, how far apart the objects end, and where the CPU time goes. `--soak N` makes N random and
adversarial pushes instead and stops at the first that crashes, hangs or teleports something.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from envs.objects import ObjectParameters, ObjectRanges, draw_objects
from envs.physics import Poses
from envs.policy import HeuristicPushingPolicy
from envs.pushing import PushingEnv
from envs.scene import Scene
from envs.workspace import normalised_push, push_endpoints

OBJECTS, PUSHES_PER_SCENE = 4, 5
AREA = [((0.40, -0.35), (0.70, 0.35))]
MOVED = 0.005  # metres; objects that stay are where they were under any robot
PERCENTILES = (50, 75, 95, 100)
FARTHEST = 0.5  # metres that one push of 0.14 m may move an object, sliding and rolling included
LONGEST = 3000  # physics steps of one push; the Sawyer's usual ones take 700


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
    drawn = []
    for number in range(count):
        generator, points = np.random.default_rng([seed, number]).spawn(2)
        objects = draw_objects([AREA] * OBJECTS, ObjectRanges(clearance=0.12), generator)
        drawn.append(([replace(one, mass=10.0, friction=0.8) for one in objects] if heavy else objects, points))
    return drawn


def put(scene: Scene, poses: Poses) -> None:
    """Every object to a pose, asleep: each push starts from the same place under every robot."""
    for body, position, orientation in zip(scene.bodies, poses.positions, poses.orientations, strict=True):
        scene.world.client.resetBasePositionAndOrientation(body, position, orientation)
        scene.world.client.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0))
    scene.world.rest(scene.bodies)


def pushes(robot: str, assets: Path | None, count: int, heavy: bool, script: list[Any] | None) -> dict[str, Any]:
    """Make pushes; without a script the policy chooses them, with one they are taken from it."""
    scene, seconds = Scene(robot=robot, assets=assets), defaultdict(float)
    found: dict[str, Any] = {"script": [], "after": [], "ended": [], "line": [], "end": [], "seconds": seconds}
    for number, (objects, points) in enumerate(scenes(-(-count // PUSHES_PER_SCENE), heavy, seed=5)):
        seen = scene.reset(objects, points)
        policy = HeuristicPushingPolicy(np.random.default_rng(number))
        scene.robot = watched = Watched(scene.robot, scene, seconds)  # type: ignore[assignment]
        for turn in range(PUSHES_PER_SCENE):
            if script is None:
                before, action = scene.ground_truth(), policy.act(seen)
                found["script"].append((before, action))
            else:
                before, action = script[number * PUSHES_PER_SCENE + turn]
            put(scene, before)
            watched.tips = []
            report = scene.push(action)
            found["after"].append(scene.ground_truth().positions)
            found["ended"].append("unsafe" if report.unsafe else report.stopped)
            if watched.tips and not report.stopped:
                deviation, last = line(np.array(watched.tips), action)
                found["line"].append(deviation)
                found["end"].append(last)
            seen = scene.observe() if script is None else seen
    scene.close()
    return found


def line(tips: np.ndarray, action: np.ndarray) -> tuple[float, float]:
    """How far the tip was from its line at most, and from the line's end at last: metres."""
    start, end = push_endpoints(action)
    way = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    across = (tips[:, :2] - start) @ np.array([-way[1], way[0]])
    return float(np.abs(across).max()), float(np.linalg.norm(tips[-1, :2] - end))


def compare(reference: dict[str, Any], other: dict[str, Any]) -> np.ndarray:
    """Metres between where the objects end under two robots, of those that either moved: [N]."""
    apart = []
    rows = zip(reference["script"], reference["after"], other["after"], other["ended"], strict=True)
    for (before, _), one, two, ended in rows:
        moved = np.maximum(*(np.linalg.norm(after - before.positions, axis=1) for after in (one, two))) > MOVED
        on_table = (np.minimum(one[:, 2], two[:, 2]) > -0.02) & (before.positions[:, 2] > -0.02)
        if ended == "":
            apart += np.linalg.norm(one - two, axis=1)[moved & on_table].tolist()
    return np.array(apart)


def millimetres(values: Any) -> str:
    if not len(values):
        return "none"
    return " / ".join(f"{1e3 * value:.2f}" for value in np.percentile(values, PERCENTILES))


def measure(robots: list[str], assets: Path | None, count: int, weights: list[str]) -> dict[str, Any]:
    results = {}
    for weight in weights:
        stick = pushes("stick", assets, count, weight == "heavy", None)
        print(f"{weight} objects, {len(stick['ended'])} pushes; millimetres at {PERCENTILES} %")
        # The same pushes again: what is left between two runs of one robot is the scenes' own doing.
        for name in ["stick", *robots]:
            found = pushes(name, assets, count, weight == "heavy", stick["script"])
            apart = compare(stick, found)
            done = len(found["line"])
            print(f"  {name}: ended {dict(Counter(found['ended']))}")
            print(f"    tip off its line {millimetres(found['line'])}, off its end {millimetres(found['end'])}")
            print(f"    {len(apart)} moved objects end this far from the stick's {millimetres(apart)}")
            split = ", ".join(f"{phase} {1e3 * time / done:.1f}" for phase, time in found["seconds"].items())
            print(f"    CPU ms per push: {1e3 * sum(found['seconds'].values()) / done:.1f} ({split})", flush=True)
            results[f"{weight} {name}"] = {
                "apart": apart.tolist(), "line": found["line"], "end": found["end"], "ended": found["ended"],
            }  # fmt: skip
    return results


def adversarial(number: int, seen: dict[str, np.ndarray], generator: np.random.Generator) -> np.ndarray:
    """By turns: at random, far out of range, into the pile, outwards at the border, not finite."""
    kind = number % 5
    action = generator.uniform(-1, 1, 4)
    if kind == 1:
        action = generator.normal(scale=10.0 ** generator.integers(0, 30), size=4)
    elif kind == 2:
        aim, start = seen["centers"][generator.integers(seen["mask"].sum()), :2], generator.uniform(0.03, 0.09)
        way = generator.normal(size=2)
        way /= np.linalg.norm(way)
        action = normalised_push(aim - start * way, 0.1 * way)
    elif kind == 3:
        action[generator.integers(2)] = action[2 + generator.integers(2)] = generator.choice([-1.0, 1.0])
    elif kind == 4:
        action[generator.integers(4)] = generator.choice([np.nan, np.inf, -np.inf])
    return action


def soak(robot: str, assets: Path | None, count: int, seed: int = 0) -> Counter[str]:
    """Make `count` pushes that mean no good, and check after each that the world is still one."""
    env, generator, ends = PushingEnv(objects=5, robot=robot, assets=assets), np.random.default_rng(seed), Counter()
    seen, _ = env.reset(seed=seed)
    for number in range(count):
        action, before, steps = adversarial(number, seen, generator), env.scene.ground_truth(), [0]
        if not np.isfinite(action).all():
            try:
                env.step(action)
            except ValueError:
                ends["refused"] += 1
                continue
            raise AssertionError(f"push {number}: {action} was not refused")
        plain_step = env.scene.world.step

        def counted(step: Any = plain_step, steps: list[int] = steps) -> None:
            steps[0] += 1
            step()

        env.scene.world.step = counted  # type: ignore[method-assign]
        seen, reward, terminated, truncated, info = env.step(action)
        env.scene.world.step = plain_step  # type: ignore[method-assign]
        after = env.scene.ground_truth()
        here = after.positions[:, 2] > -0.02
        far = np.linalg.norm((after.positions - before.positions)[:, :2], axis=1)[here]
        assert steps[0] <= LONGEST, f"push {number}: {action} took {steps[0]} steps"
        assert (far < FARTHEST).all(), f"push {number}: {action} moved an object by {far.max():.2f} m"
        assert np.isfinite(after.positions).all() and np.isfinite(reward) and env.observation_space.contains(seen)
        ends["unsafe" if info["unsafe"] else info["stopped"] or "done"] += 1
        if terminated or truncated:
            seen, _ = env.reset()
    env.close()
    return ends


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pushes", type=int, default=500)
    parser.add_argument("--robots", nargs="+", default=["sawyer", "panda"])
    parser.add_argument("--weights", nargs="+", default=["light", "heavy"], choices=["light", "heavy"])
    parser.add_argument("--assets", type=Path, default=Path("../shared/assets"))
    parser.add_argument("--json", type=Path, help="where the single deviations are written")
    parser.add_argument("--soak", type=int, help="make so many adversarial pushes instead")
    words = parser.parse_args()
    if words.soak:
        for robot in words.robots:
            ends = soak(robot, words.assets, words.soak)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{robot}: {words.soak} pushes survived, {dict(ends)}; at most {peak:.0f} MiB of memory")
        return
    results = measure(words.robots, words.assets, words.pushes, words.weights)
    if words.json:
        words.json.write_text(json.dumps(results))


if __name__ == "__main__":
    main()
