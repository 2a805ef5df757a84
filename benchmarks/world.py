"""Does the world last? `python benchmarks/world.py --resets 20000 --pushes 100000 --log runs/world.jsonl`

Resets scenes of all tasks and pushes in them, some of them adversarial, in one process. Prints the rates,
resident memory over time and its slope, objects that went through the table, the fastest that anything moved, and
what became of every kind of action. Exit status 1 where something crashed, hung, fell through or jumped.

Every five hundred are a line of the log. Started again with the same log, it goes on after the last line.
`--robot sawyer --assets DIR` does the same with an arm, at an eighth of the stick's rate.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.storage.progress import progress_bar
from envs.objects.sampling import ObjectRanges
from envs.observation import Observation
from envs.physics import TIME_STEP
from envs.policy import HeuristicPushingPolicy
from envs.pushing import ObservationDict, PushingEnv
from envs.robots import ROBOTS
from envs.scene import FALLEN, Scene
from envs.tasks import TASKS
from envs.workspace import OBJECT_SLOTS, TABLE_HIGH, TABLE_LOW, normalised_push

EPISODE = 20  # pushes after which a new scene is sampled, if it has not ended before
EVERY = 5  # physics steps between two looks at the objects
SPEED = 2.0  # metres per second, sideways or upwards; the tool goes at most 0.7
FALLING = 4.0  # metres per second, downwards; where objects lie close, one of five may be dropped from 0.7 m (3.7 m/s)
EDGE = 0.03  # metres; what is lower than `FALLEN` and farther than this inside the table's edges went into it
PATIENCE = 30.0  # seconds of CPU time for one reset or push; wall time would count a busy machine as a hang

Push = NDArray[np.float32]


class Watch:
    """Looks at the objects every few physics steps, for what no push may do."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.jumps, self.through, self.deepest = scene, 0, 0, 1.0
        self.fastest = np.zeros(2)  # sideways or upwards, downwards
        self._before: NDArray[np.float64] | None = None
        self._steps = 0
        step, reset = scene.world.step, scene.world.reset

        def watched_step() -> None:
            step()
            self._steps += 1
            if self._steps % EVERY == 0:
                self._look()

        def watched_reset() -> None:
            reset()
            self._before, self._steps = None, 0

        scene.world.step, scene.world.reset = watched_step, watched_reset  # type: ignore[method-assign]

    def _look(self) -> None:
        now = self.scene.ground_truth().positions
        inside = (now[:, :2] > np.array(TABLE_LOW) + EDGE) & (now[:, :2] < np.array(TABLE_HIGH) - EDGE)
        heights = now[inside.all(axis=-1), 2]
        self.through += int((heights < FALLEN).sum())
        self.deepest = min(self.deepest, heights.min(initial=1.0))
        if self._before is not None:
            above = (now[:, 2] > 0.0) | ~np.isfinite(now).all(axis=-1)  # what fell off the table may fall freely
            velocity = (now - self._before)[above] / (EVERY * TIME_STEP)
            down = np.maximum(-velocity[:, 2], 0.0)
            other = np.linalg.norm(np.maximum(velocity, [-np.inf, -np.inf, 0.0]), axis=-1)
            speeds = np.stack([other, down], axis=-1)
            self.jumps += int((~(speeds <= (SPEED, FALLING))).any(axis=-1).sum())
            self.fastest = np.fmax(self.fastest, speeds.max(axis=0, initial=0.0))
        self._before = now


def adversarial_push(kind: str, observation: ObservationDict, generator: np.random.Generator) -> Push:
    """An adversarial push [4]; `observation` holds at least one object."""
    real = np.flatnonzero(observation["mask"])
    center = observation["centers"][generator.choice(real), :2].astype(np.float64)
    angle = generator.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    anything = generator.uniform(-1.0, 1.0, size=4)
    if kind in ("NaN", "infinite"):
        anything[generator.integers(4)] = np.nan if kind == "NaN" else generator.choice([-np.inf, np.inf])
    elif kind == "out of range":
        anything *= 10.0 ** generator.uniform(0.5, 30.0)
    elif kind == "onto an object":
        anything = normalised_push(center, 0.1 * direction)
    elif kind == "into the pile":
        middle = observation["centers"][real, :2].mean(axis=0)
        toward = (middle - center) / max(float(np.linalg.norm(middle - center)), 1e-6)
        anything = normalised_push(center - 0.08 * toward, 0.141 * toward)
    elif kind == "off the table":
        distances = np.concatenate([center - TABLE_LOW, TABLE_HIGH - center])
        outward = np.array([[-1, 0], [0, -1], [1, 0], [0, 1]])[distances.argmin()]
        anything = normalised_push(center - 0.08 * outward, 0.2 * outward)
    return anything.astype(np.float32)


KINDS = ("NaN", "infinite", "out of range", "onto an object", "into the pile", "off the table")


class World:
    """The environments that are reset and pushed in, one per task, and their watches."""

    def __init__(self, robot: str, assets: Path | None) -> None:
        arguments: dict[str, Any] = {"layout": "random", "ranges": ObjectRanges(clearance=0.1), "robot": robot}
        self.envs = [PushingEnv(task=task, assets=assets, **arguments) for task in TASKS]
        self.watches = [Watch(env.scene) for env in self.envs]

    def reset(self, number: int) -> tuple[PushingEnv, ObservationDict]:
        """Scene `number`: tasks and 1 to 5 objects take turns."""
        env = self.envs[number % len(self.envs)]
        env.objects = 1 + number // len(self.envs) % OBJECT_SLOTS
        observation, _ = env.reset(seed=number)
        return env, observation

    def report(self) -> dict[str, float]:
        """The worst since the last report."""
        worst: dict[str, float] = {
            "fastest_m_s": float(max(watch.fastest[0] for watch in self.watches)),
            "falling_m_s": float(max(watch.fastest[1] for watch in self.watches)),
            "deepest_m": float(min(watch.deepest for watch in self.watches)),
            "jumps": sum(watch.jumps for watch in self.watches),
            "through": sum(watch.through for watch in self.watches),
        }
        for watch in self.watches:
            watch.fastest, watch.jumps, watch.through, watch.deepest = np.zeros(2), 0, 0, 1.0
        return worst


def reset_some(world: World, first: int, count: int, advance: Callable[[], Any]) -> Counter[str]:
    for number in range(first, first + count):
        signal.setitimer(signal.ITIMER_PROF, PATIENCE)
        world.reset(number)
        advance()
    return Counter()


def push_some(world: World, first: int, count: int, advance: Callable[[], Any], *, share: float) -> Counter[str]:
    """Push on scenes of their own numbers, so that a chunk does not depend on those before it."""
    ends: Counter[str] = Counter()
    made, number = 0, 10**6 + first
    while made < count:
        signal.setitimer(signal.ITIMER_PROF, PATIENCE)
        env, observation = world.reset(number)
        generator = np.random.default_rng([number, 2])
        policy = HeuristicPushingPolicy(generator)
        for _ in range(min(EPISODE, count - made)):
            signal.setitimer(signal.ITIMER_PROF, PATIENCE)
            kind = str(generator.choice(KINDS)) if generator.random() < share else "heuristic"
            action = (
                adversarial_push(kind, observation, generator)
                if kind in KINDS
                else policy.act(_observation(observation)).astype(np.float32)
            )
            before, made, terminated = env.scene.ground_truth().positions, made + 1, False
            advance()
            try:
                observation, _, terminated, _, info = env.step(action)
            except ValueError:  # what is not finite is refused, and nothing else
                still = np.array_equal(before, env.scene.ground_truth().positions)
                ends[f"{kind}: {'refused' if still and kind in ('NaN', 'infinite') else 'WRONG'}"] += 1
                continue
            done = "unsafe, not done" if info["unsafe"] else info["stopped"] or "done"
            accepted = "WRONG" if kind in ("NaN", "infinite") else done
            ends[f"{kind}: {accepted}"] += 1
            ends["objects off the table"] += info["fall"]
            if terminated:
                break
        number += 1
    return ends


def _observation(observation: ObservationDict) -> Observation:
    return Observation(
        observation["clouds"],
        observation["centers"],
        observation["mask"].astype(bool),
        observation["visible"].astype(bool),
    )


def resident() -> float:
    """Megabytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _hung(*_: object) -> None:
    raise TimeoutError(f"a reset or push took more than {PATIENCE:g} s of CPU time")


def run(
    phase: str,
    some: Callable[..., Counter[str]],
    total: int,
    log: Path,
    lines: list[dict[str, Any]],
    make_world: Callable[[], World],
    chunk: int,
) -> None:
    """Do what the log does not hold yet of one phase, chunk by chunk, in a world of its own."""
    done = sum(line["count"] for line in lines if line["phase"] == phase)
    world, unit = make_world(), {"resets": "reset", "pushes": "push"}[phase]
    with progress_bar(phase, total=total, initial=done, unit=unit) as bar:
        while done < total:
            count, began, cpu = min(chunk, total - done), time.perf_counter(), time.process_time()
            ends = some(world, done, count, bar.update)
            signal.setitimer(signal.ITIMER_PROF, 0)
            line = {
                "phase": phase,
                "count": count,
                "process": os.getpid(),
                "wall_s": time.perf_counter() - began,
                "cpu_s": time.process_time() - cpu,
                "resident_MB": resident(),
                **world.report(),
                "ends": dict(sorted(ends.items())),
            }
            lines.append(line)
            with open(log, "a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            done += count
    for env in world.envs:
        env.close()


def summary(phase: str, lines: list[dict[str, Any]]) -> bool:
    """Print what a phase came to; returns whether all was well."""
    lines = [line for line in lines if line["phase"] == phase]
    if not lines:
        return True
    count, wall, cpu = (sum(line[name] for line in lines) for name in ("count", "wall_s", "cpu_s"))
    jumps, through = (sum(line[name] for line in lines) for name in ("jumps", "through"))
    print(f"{count} {phase}: {count / wall:.1f} per second of wall time, {1e3 * cpu / count:.2f} ms of CPU time each")
    last = [line for line in lines if line["process"] == lines[-1]["process"]]
    memory, done = [line["resident_MB"] for line in last], np.cumsum([line["count"] for line in last])
    shown = [f"{memory[index]:.1f}" for index in np.linspace(0, len(memory) - 1, min(8, len(memory))).astype(int)]
    print(f"  resident memory, MB, over the last process's {done[-1]}: {' '.join(shown)}")
    if len(memory) > 3:
        late = slice(len(memory) // 4, None)  # caches have filled by then
        slope = np.polyfit(done[late], memory[late], 1)[0]
        print(f"  slope after the first quarter: {1e3 * slope:+.3f} MB per 1,000")
    fastest, falling = (max(line[name] for line in lines) for name in ("fastest_m_s", "falling_m_s"))
    print(f"  objects above the table: {fastest:.2f} m/s sideways or upwards (limit {SPEED:g})", end=", ")
    print(f"{falling:.2f} m/s downwards (limit {FALLING:g})")
    deepest = min(line["deepest_m"] for line in lines)
    print(f"  {jumps} jumps, {through} looks at an object inside the table; lowest centre {1e3 * deepest:+.1f} mm")
    ends: Counter[str] = Counter()
    for line in lines:
        ends.update(line["ends"])
    for name, times in sorted(ends.items()):
        print(f"  {name:32} {times:7}", flush=True)
    return not (jumps or through or any("WRONG" in name for name in ends))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resets", type=int, default=1000)
    parser.add_argument("--pushes", type=int, default=1000)
    parser.add_argument("--adversarial", type=float, default=0.25, help="share of adversarial pushes")
    parser.add_argument("--robot", default="stick", choices=list(ROBOTS))
    parser.add_argument("--assets", type=Path, help="folder of the files that some robots need")
    parser.add_argument("--chunk", type=int, default=500, help="resets or pushes per line of the log")
    parser.add_argument("--log", type=Path, help="by default runs/world-ROBOT.jsonl")
    arguments = parser.parse_args()
    arguments.log = arguments.log or Path("runs", f"world-{arguments.robot}.jsonl")
    arguments.log.parent.mkdir(parents=True, exist_ok=True)
    text = arguments.log.read_text(encoding="utf-8") if arguments.log.exists() else ""
    lines = [json.loads(line) for line in text.splitlines()]
    signal.signal(signal.SIGPROF, _hung)
    world = partial(World, arguments.robot, arguments.assets)
    run("resets", reset_some, arguments.resets, arguments.log, lines, world, arguments.chunk)

    def push(*given: Any) -> Counter[str]:
        return push_some(*given, share=arguments.adversarial)

    run("pushes", push, arguments.pushes, arguments.log, lines, world, arguments.chunk)
    well = [summary(phase, lines) for phase in ("resets", "pushes")]
    sys.exit(0 if all(well) else 1)


if __name__ == "__main__":
    main()
