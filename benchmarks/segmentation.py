"""How well objects are found in depth images alone: `python benchmarks/segmentation.py [--scenes N] [--episodes N]`.

Under `camera=kinect2`, `segmentation=clusters` against the simulator's own mask of the same images. First single images
of random scenes of 1 to 5 objects: the number of objects, and the distance between the centres that both give. Then
whether every object keeps its place in the list from the first image to the last: over ten pushes of the heuristic
policy, from such scenes and from objects in clutter as when collecting, and over whole episodes of the three
tasks with 3 and 5 objects, as the shipped checkpoint plays them (`planner=cavin`, sparse rewards, at most 60 pushes).
An episode in whose first image the number is wrong does not begin, as in `Scene.sample`.
Results go to a file line by line (--log), from which a run that was stopped goes on. --pictures DIR draws what failed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from cavin_pyro.config.composition import compose
from cavin_pyro.data.collection import clutter_area
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.storage.progress import progress_bar
from envs.objects.sampling import WHOLE_TABLE, ObjectRanges
from envs.observation import MINIMUM_PIXELS, Observation
from envs.policy import HeuristicPushingPolicy
from envs.scene import Scene
from envs.segmentation import ClusterSegmenter, Pixels, Segmenter
from envs.sensors import DepthImage

SEED = 5
TASKS = ("clearing", "insertion", "crossing")
PUSHES = 10
View = tuple[DepthImage, list[np.ndarray]]
Pictures = Callable[[str, View, list[Pixels], list[Any]], None]  # the last: whose colour each place has


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--clutters", type=int, default=200)
    parser.add_argument("--tasks", type=int, default=240)
    parser.add_argument("--log", type=Path, default=Path("runs/segmentation.jsonl"))
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    arguments.log.parent.mkdir(parents=True, exist_ok=True)
    done = [json.loads(line) for line in arguments.log.read_text().splitlines()] if arguments.log.exists() else []
    scene = Scene(camera="kinect2", segmentation="mask")
    picture = draw_into(arguments.pictures) if arguments.pictures else lambda *_: None
    with open(arguments.log, "a", encoding="utf-8") as log:
        for kind, count, run in (
            ("scene", arguments.scenes, one_scene),
            ("episode", arguments.episodes, one_episode),
            ("clutter", arguments.clutters, partial(one_episode, cluttered=True)),
            ("task", arguments.tasks, one_task),
        ):
            known = {line["number"] for line in done if line["kind"] == kind}
            with progress_bar(kind + "s", total=count, initial=len(known), unit=kind) as bar:
                for number in sorted(set(range(count)) - known):
                    line = {"kind": kind, "number": number, **run(scene, number, picture)}
                    done.append(line)
                    log.write(json.dumps(line) + "\n")
                    log.flush()
                    bar.update(1)
    report(done)


def begin(scene: Scene, number: int, *, cluttered: bool = False) -> tuple[np.random.Generator, Any]:
    """Draw a scene of 1 to 5 objects anywhere on the table, or of 2 to 5 as close to each other as when collecting."""
    generator = np.random.default_rng([SEED, number])
    count = int(generator.integers(2 if cluttered else 1, 6))
    area, ranges = (
        (clutter_area(generator), ObjectRanges(clearance=0.12)) if cluttered else (WHOLE_TABLE, ObjectRanges())
    )
    return generator, scene.sample([area] * count, ranges, generator)


def capture(scene: Scene) -> View:
    """A new image, and for each object the pixels that the simulator says are its own and have a measurement."""
    image = scene.capture()
    return image, [mask & (image.depth > 0.0) for mask in scene.true_masks()]


def owners(found: list[Pixels], truth: list[np.ndarray]) -> list[int | None]:
    """The object to which most pixels of each place in the list belong; -1 for none, None if it is not visible."""
    named: list[int | None] = []
    for pixels in found:
        counts = [int(mask[pixels].sum()) for mask in truth]
        enough = len(pixels[0]) >= MINIMUM_PIXELS
        named.append((int(np.argmax(counts)) if 2 * max(counts) > len(pixels[0]) else -1) if enough else None)
    return named


def one_scene(scene: Scene, number: int, picture: Pictures) -> dict[str, Any]:
    begin(scene, number)
    view = capture(scene)
    return judge_scene(view, scene.point_at_target(view[0]), number, picture)


def judge_scene(view: View, target: tuple[int, int] | None, number: int, picture: Pictures) -> dict[str, Any]:
    image, truth = view
    began = time.process_time()
    found = ClusterSegmenter().start(image, target)
    spent = time.process_time() - began
    named = owners(found, truth)
    visible = [body for body, mask in enumerate(truth) if mask.sum() >= MINIMUM_PIXELS]
    right = sum(name is not None for name in named) == len(visible)
    errors = []
    for name, pixels in zip(named, found, strict=True):
        if name is not None and name >= 0:
            centers = [
                image.camera.points(image.depth, *where).mean(axis=0) for where in (np.nonzero(truth[name]), pixels)
            ]
            errors.append(float(np.linalg.norm(centers[0] - centers[1])))
    if not right:
        picture(f"scene {number}", view, found, list(range(len(found))))
    return {"objects": len(visible), "right": right, "errors": errors, "seconds": spent}


def one_episode(scene: Scene, number: int, picture: Pictures, *, cluttered: bool = False) -> dict[str, Any]:
    generator, observation = begin(scene, (2 if cluttered else 1) * 10**6 + number, cluttered=cluttered)
    policy = HeuristicPushingPolicy(generator.spawn(1)[0])

    def later(observation: Observation) -> Iterator[View]:
        for _ in range(PUSHES):
            fallen = scene.push(policy.act(observation)).fallen
            observation = scene.observe()
            yield capture(scene)
            if fallen:
                return

    view = capture(scene)
    name = f"{'clutter' if cluttered else 'episode'} {number}"
    return judge_episode(view, scene.point_at_target(view[0]), later(observation), name, picture)


def judge_episode(
    view: View, target: tuple[int, int] | None, later: Iterable[View], episode: str, picture: Pictures
) -> dict[str, Any]:
    segmenter = ClusterSegmenter()
    first = owners(segmenter.start(view[0], target), view[1])
    if sorted(name for name in first if name is not None) != list(range(len(view[1]))):
        return {"begun": False}
    kept, counted, seconds = True, 0, []
    for image, truth in later:
        began = time.process_time()
        found = segmenter.follow(image)
        seconds.append(time.process_time() - began)
        named = owners(found, truth)
        counted += int(sum(name is not None for name in named) == sum(mask.sum() >= MINIMUM_PIXELS for mask in truth))
        lost = any(name not in (None, was) for name, was in zip(named, first, strict=True))
        if lost and kept:
            picture(f"{episode} image {len(seconds)}", (image, truth), found, first)
        kept = kept and not lost
    return {"begun": True, "kept": kept, "counted": counted, "images": len(seconds), "seconds": seconds}


class Watched:
    """Segments as another segmenter does, and notes the first image in which something is out of its place."""

    def __init__(self, segmenter: Segmenter, scene: Scene, picture: Pictures) -> None:
        self.segmenter, self.scene, self.picture = segmenter, scene, picture
        self.name, self.images, self.kept = "", 0, True

    def start(self, image: DepthImage, target: tuple[int, int] | None) -> list[Pixels]:
        self.images, self.kept = 0, True
        return self.segmenter.start(image, target)

    def follow(self, image: DepthImage) -> list[Pixels]:
        found = self.segmenter.follow(image)
        self.images += 1
        truth = [mask & (image.depth > 0.0) for mask in self.scene.true_masks()]
        # The scene numbers its bodies as the first image did, so every place has its own number.
        if self.kept and any(name not in (None, place) for place, name in enumerate(owners(found, truth))):
            self.kept = False
            self.picture(f"{self.name} image {self.images}", (image, truth), found, list(range(len(found))))
        return found


@cache
def task_runner(task: str, objects: int) -> EpisodeRunner:
    world = ("env.camera=kinect2", "env.segmentation=clusters")
    return make_runner(compose("evaluate", f"task={task}", f"objects={objects}", "reward=sparse", *world))


def one_task(_: Scene, number: int, picture: Pictures) -> dict[str, Any]:
    """Tasks and numbers of objects take turns."""
    task, objects = TASKS[number % 3], (3, 5)[number // 3 % 2]
    one = task_runner(task, objects)
    scene = one.env.scene
    if not isinstance(scene.segmenter, Watched):
        scene.segmenter = Watched(scene.segmenter, scene, picture)
    watched = scene.segmenter
    watched.name = f"{task} {number}"
    outcome = one.rollout(number).outcome
    return {"task": task, "objects": objects, "kept": watched.kept, "images": watched.images, "outcome": outcome}


def report(lines: list[dict[str, Any]]) -> None:
    scenes = [line for line in lines if line["kind"] == "scene"]
    if scenes:
        print(share("right number of objects", sum(line["right"] for line in scenes), len(scenes)))
        for count in range(1, 6):
            some = [line["right"] for line in scenes if line["objects"] == count]
            if some:
                print(share(f"  of {count}", sum(some), len(some)))
        errors = 1e3 * np.array([error for line in scenes for error in line["errors"]])
        interval = bootstrap((errors,), np.median, n_resamples=1000, rng=0).confidence_interval
        tail = ", ".join(f"{np.percentile(errors, rank):.1f} mm in {rank} %" for rank in (90, 95, 99))
        print(
            f"centre error: median {np.median(errors):.2f} mm [{interval.low:.2f}, {interval.high:.2f}], at most {tail}"
        )
        print(f"CPU time: {1e3 * np.median([line['seconds'] for line in scenes]):.1f} ms for a first image")
    for kind, where in (("episode", "anywhere"), ("clutter", "in clutter")):
        some = [line for line in lines if line["kind"] == kind]
        begun = [line for line in some if line["begun"]]
        if not begun:
            continue
        print(f"{where}: {len(begun)} of {len(some)} episodes begun")
        print(share("identities kept over the episode", sum(line["kept"] for line in begun), len(begun)))
        images = sum(line["images"] for line in begun)
        print(share("right number of objects in later images", sum(line["counted"] for line in begun), images))
        spent = 1e3 * np.concatenate([line["seconds"] for line in begun])
        print(
            f"CPU time of a later image: median {np.median(spent):.1f}, mean {spent.mean():.1f}, {spent.max():.0f} ms"
        )

    tasks = [line for line in lines if line["kind"] == "task"]
    for objects in (3, 5):
        some = [line for line in tasks if line["objects"] == objects]
        if some:
            print(f"tasks with {objects} objects: {np.mean([line['images'] for line in some]):.1f} pushes per episode")
            print(share("identities kept over the whole episode", sum(line["kept"] for line in some), len(some)))


def share(what: str, count: int, of: int) -> str:
    rate = wilson(count, of)
    return f"{what}: {100 * rate['rate']:.1f} % [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}], {count} of {of}"


def draw_into(folder: Path) -> Pictures:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)

    def picture(name: str, view: View, found: list[Pixels], colors: list[Any]) -> None:
        image, truth = view
        figure, panels = pyplot.subplots(1, 3, figsize=(15, 4.8), layout="constrained")
        panels[0].imshow(np.where(image.depth > 0, image.depth, np.nan), cmap="viridis_r", vmin=0.8, vmax=1.1)
        labels = np.full((2, *image.depth.shape), np.nan)
        for number, mask in enumerate(truth):
            labels[0][mask] = number
        for color, pixels in zip(colors, found, strict=True):
            labels[1][pixels] = color
        for panel, label in zip(panels[1:], labels, strict=True):
            panel.imshow(label, cmap="tab10", vmin=0, vmax=9, interpolation="nearest")
        for panel, title in zip(panels, (f"{name}: depth", "mask (simulator)", "clusters (depth alone)"), strict=True):
            panel.set(title=title, xticks=[], yticks=[])
        figure.savefig(folder / f"{name.replace(' ', '_')}.png", dpi=70)
        pyplot.close(figure)

    return picture


if __name__ == "__main__":
    main()
