"""How far predictions are off, beside what nobody could predict: `python benchmarks/accuracy.py CHECKPOINT ...`.

New episodes are collected by the heuristic (--episodes, --seed: of the collection), in the default world or in another
(--object-set, --assets, --camera). For every object it prints the distance between the predicted and the observed
centre, after one push, after three (f reads its own predictions), and for h with the code that the guide infers from
the three pushes' outcome. Objects that moved more than a centimetre by the simulator stand apart from those that moved
less than 2 mm, and among the latter those of which f says that they move more than 2 cm; these once more by pushes that
the robot began alone: a push that would touch down on an object is not begun, and nothing moves. By number of objects,
by object, and by the kind of push:

hit     the tool's path passes within half of the object's half-width (across the path) from its middle
graze   within all of it and the tool's radius
miss    farther off, or the push ends before the object

The floor has four parts. Hidden: the distance between an object's motion and its mean in --redraws replays of the
same push in a second world, from the same poses, with mass and friction drawn anew within their ranges (those that
leave the object on the table). Place: the same for somebody who also sees where each object lies only to within
--place-error (standard deviation in x and in y), so that the replays begin around the place that he sees. Facets:
as hidden, with cans and cups turned about their own axis by any angle: they are prisms with 16 and 10 sides, and no
image of this resolution tells which of them the tool meets. Camera: the
distance between the motion of the mean of the visible points and that of the body. `--picture FILE` draws all of it.
`--policy model` has pushes that `--pusher CHECKPOINT` chooses, as in `collect policy=model`.
`--objects 8 10` is for other numbers of objects than 1 to 5, and `--neighbours 4 9` predicts once with the nearest 4
other objects in each relation, and once with the nearest 9.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray
from pyro import poutine
from scipy.spatial.transform import Rotation

from cavin_pyro.config.commands.collection import POLICIES
from cavin_pyro.config.commands.world import WorldConfig
from cavin_pyro.criticism.loading import load_programs
from cavin_pyro.data.collection import CollectionConfig, check_policy, clutter_area, open_scene, pushing_policy
from cavin_pyro.data.features import cloud_features
from cavin_pyro.storage.checkpoint import find_checkpoint, load_checkpoint
from cavin_pyro.storage.geometry import geometry_of
from cavin_pyro.storage.progress import progress_bar
from envs.objects.object_sets import plain_name
from envs.observation import Observation
from envs.physics import Poses
from envs.randomness import collection_streams
from envs.robots import STICK_RADIUS
from envs.scene import FALLEN, Scene
from envs.workspace import OBJECT_SLOTS, push_endpoints
from models.state import State, Window, stack_steps

T = 3  # pushes of a segment
ROUND = ("tomato_soup_can", "tuna_fish_can", "a_cups")  # about their own z axis, but for their flat sides
MOVED, STILL, PHANTOM = 0.01, 0.002, 0.02  # metres
Table = dict[str, "Errors"]
Replays = dict[int, NDArray[np.float64]]  # [redraws, objects, 3] motions in metres after 1 and T pushes; NaN if fallen


@dataclass
class Push:
    """One push: what was seen, where the bodies were, and where the same push took them in worlds drawn anew."""

    before: Observation
    after: Observation
    action: NDArray[np.float32]
    begun: bool  # not where it would have touched down on an object
    start: NDArray[np.float64]  # [objects, 3] metres, bodies before and after
    end: NDArray[np.float64]
    replayed: Replays  # from where the bodies were
    displaced: Replays  # from around where somebody saw them
    turned: Replays  # with round objects turned about their axes


@dataclass
class Episode:
    """Names of the objects, and pushes."""

    names: list[str]
    pushes: list[Push]


def play(scene: Scene, twin: Scene, config: CollectionConfig, number: int, redraws: int, place_error: float) -> Episode:
    """An episode as `collect` has it, until something falls, and its replays."""
    generator, policy_generator = collection_streams(config.seed, number)
    count = int(generator.integers(config.minimum_objects, config.maximum_objects + 1))
    seen = [scene.sample([clutter_area(generator)] * count, config.ranges, generator)]
    policy = pushing_policy(config, policy_generator)
    there, actions, begun = [scene.ground_truth()], [], []
    for _ in range(config.steps):
        action = policy.act(seen[-1]).astype(np.float32)
        report = scene.push(action)
        if report.fallen:
            break
        begun.append(not report.unsafe)
        actions.append(action)
        there.append(scene.ground_truth())
        seen.append(scene.observe())
    again, displaced, turned = (
        replays(scene, twin, config, there, actions, redraws, number, error, turning)
        for error, turning in ((0.0, False), (place_error, False), (0.0, True))
    )
    pushes = []
    for t, action in enumerate(actions):
        bodies = there[t].positions, there[t + 1].positions
        pushes.append(Push(seen[t], seen[t + 1], action, begun[t], *bodies, again[t], displaced[t], turned[t]))
    return Episode([each.name for each in scene.objects], pushes)


def replays(
    scene: Scene,
    twin: Scene,
    config: CollectionConfig,
    there: list[Poses],
    actions: list[NDArray[np.float32]],
    redraws: int,
    number: int,
    place_error: float,
    turning: bool,
) -> list[Replays]:
    """For every push: motions after 1 and, where there are as many, after T pushes.

    place_error: metres, of the place that is seen from the true one, and of the true one from that; 0 for the true one.
    turning: whether round objects begin turned about their axes.
    """
    angles = np.random.default_rng([config.seed, number, 2])
    round_ones = [place for place, each in enumerate(scene.objects) if plain_name(each.name) in ROUND]
    generator, places = (np.random.default_rng([config.seed, number, *of]) for of in ((), (1,)))
    motions: list[dict[int, list[NDArray[np.float64]]]] = [defaultdict(list) for _ in actions]
    seen = [place_error * places.standard_normal((len(scene.objects), 2)) for _ in actions]
    for _ in range(redraws):
        objects = []
        for each in scene.objects:
            mass = scene.object_set.asset(each.name).mass * generator.uniform(*config.ranges.mass)
            objects.append(replace(each, mass=mass, friction=generator.uniform(*config.ranges.friction)))
        twin.reset(objects, generator)
        for t in range(len(actions)):
            start = there[t].positions.copy()
            start[:, :2] += seen[t] + place_error * places.standard_normal(seen[t].shape)
            orientations = there[t].orientations.copy()
            if turning and round_ones:
                turns = Rotation.from_euler("z", angles.uniform(0.0, 2.0 * np.pi, len(round_ones)))
                orientations[round_ones] = (Rotation.from_quat(orientations[round_ones]) * turns).as_quat()
            twin.world.restore(twin.bodies, Poses(start, orientations))
            for ahead, action in enumerate(actions[t : t + T], start=1):
                twin.push(action)
                if ahead in (1, T):
                    end = twin.ground_truth().positions
                    motions[t][ahead].append(np.where(end[:, 2:] > FALLEN, end - start, np.nan))
    return [{ahead: np.array(drawn) for ahead, drawn in each.items()} for each in motions]


def kind(before: Observation, action: NDArray[np.float32], slot: int) -> str:
    """hit, graze or miss."""
    start, end = push_endpoints(action)
    length = max(float(np.linalg.norm(end - start)), 1e-6)
    forward = (end - start) / length
    points = before.clouds[slot][:, :2] - start
    along, across = points @ forward, points @ np.array([-forward[1], forward[0]])
    if along.min() > length + STICK_RADIUS or along.max() < -STICK_RADIUS:
        return "miss"
    middle, half = abs(across.max() + across.min()) / 2, (across.max() - across.min()) / 2
    if middle < half / 2:
        return "hit"
    return "graze" if middle < half + STICK_RADIUS else "miss"


class Errors:
    """Distances in metres of one predictor, by group."""

    def __init__(self) -> None:
        self.moved: dict[str, list[float]] = defaultdict(list)
        self.still: list[float] = []
        self.phantoms: list[bool] = []
        self.begun: list[bool] = []  # all pushes, for each object that lay still

    def add(self, groups: Sequence[str], moved: float, error: float, begun: bool, claimed: float = 0.0) -> None:
        if moved > MOVED:
            for group in ("all", *groups):
                self.moved[group].append(error)
        elif moved < STILL:
            self.still.append(error)
            self.phantoms.append(claimed > PHANTOM)
            self.begun.append(begun)


def segments(episodes: Sequence[Episode], ahead: int) -> Iterator[tuple[Episode, int, list[Push]]]:
    """Every series of `ahead` pushes in which all objects are visible before and after."""
    for episode in episodes:
        for t in range(len(episode.pushes) - ahead + 1):
            pushes, count = episode.pushes[t : t + ahead], len(episode.names)
            if pushes[0].before.visible[:count].all() and pushes[-1].after.visible[:count].all():
                yield episode, t, pushes


def measure(episodes: Sequence[Episode], ahead: int, predicted: dict[str, list[NDArray[np.float32]]]) -> Table:
    """Errors of the floor and of predictions [M, 3] metres, one of each predictor for every one of `segments`."""
    table: Table = defaultdict(Errors)
    for number, (episode, _, pushes) in enumerate(segments(episodes, ahead)):
        first, last = pushes[0], pushes[-1]
        for slot, name in enumerate(episode.names):
            body = last.end[slot] - first.start[slot]
            moved = float(np.linalg.norm(body))
            kinds = [kind(push.before, push.action, slot) for push in pushes]
            best = min(kinds, key=("hit", "graze", "miss").index)
            begun = all(push.begun for push in pushes)
            groups: tuple[str, ...] = (f"{len(episode.names)} object{'s' * (len(episode.names) > 1)}", name, best)
            groups += ("all pushes begun",) if begun else ()
            groups += ("cans and cups",) if plain_name(name) in ROUND else ("other objects",)
            before, seen = first.before.centers[slot], last.after.centers[slot]
            for floor, again in (
                ("hidden", first.replayed),
                ("place", first.displaced),
                ("facets", first.turned),
            ):
                stayed = again[ahead][np.isfinite(again[ahead][:, slot, 2]), slot]
                if len(stayed):
                    table[floor].add(groups, moved, float(np.linalg.norm(stayed.mean(0) - body)), begun)
            table["camera"].add(groups, moved, float(np.linalg.norm(seen - before - body)), begun)
            for who, all_of in predicted.items():
                claimed = float(np.linalg.norm(all_of[number][slot] - before))
                error = float(np.linalg.norm(all_of[number][slot] - seen))
                table[who].add(groups, moved, error, begun, claimed)
    return table


@torch.inference_mode()
def predictions(
    path: str, episodes: Sequence[Episode], neighbours: int | None = None
) -> dict[int, dict[str, list[NDArray[np.float32]]]]:
    """Centres [M, 3] metres that a checkpoint predicts, by the number of pushes and the predictor.

    `neighbours`: of the option `model.neighbours`, None for the checkpoint's own.
    """
    file = find_checkpoint(path)
    checkpoint = load_checkpoint(file)
    if neighbours is not None:
        checkpoint.config["model"]["neighbours"] = neighbours
    model, guide = load_programs(checkpoint, file)
    geometry = geometry_of(checkpoint, file)

    def state(seen: Observation) -> State:
        clouds = seen.clouds - seen.centers[:, None]
        features = torch.from_numpy(cloud_features(geometry, clouds[None]))
        return State(torch.from_numpy(seen.centers)[None], features, torch.from_numpy(seen.mask)[None])

    name, found = file.parent.name if file.stem == "checkpoint" else file.stem, {}
    if neighbours is not None:
        name += f" {neighbours}"
    for ahead in (1, T):
        rolled, inferred = [], []
        for _, _, pushes in segments(episodes, ahead):
            here = first = state(pushes[0].before)
            actions = torch.from_numpy(np.stack([push.action for push in pushes]))[None]
            for action in actions.unbind(1):
                here = model.next_state(here, action)
            rolled.append(here.centers[0].numpy())
            if ahead == T and "effect_code" in model.codes:
                between = [first, *(state(push.after) for push in pushes)]
                window = Window(
                    stack_steps(between), actions, torch.ones(1, T, dtype=torch.bool), torch.ones(1, dtype=torch.bool)
                )
                site: Any = poutine.trace(guide).get_trace(window).nodes["effect_code"]
                inferred.append(model.subgoal(first, site["fn"].mean).centers[0].numpy())
        found[ahead] = {f"{name}: f": rolled, **({f"{name}: h": inferred} if inferred else {})}
    return found


def show(table: Table, ahead: int) -> None:
    """Print one horizon."""
    print(f"\nafter {ahead} {'push' if ahead == 1 else 'pushes'}: centimetres, mean / median")
    groups = sorted({group for errors in table.values() for group in errors.moved}, key=lambda one: (one != "all", one))
    print(f"{'objects that moved':28s}" + "".join(f"{who:>26s}" for who in table))
    for group in groups:
        cells = [errors.moved.get(group, []) for errors in table.values()]
        print(f"{group:20s} {len(cells[0]):6d} " + "".join(f"{_centimetres(cell):>26s}" for cell in cells))
    stills = [errors.still for errors in table.values()]
    print(f"{'still':20s} {len(stills[0]):6d} " + "".join(f"{_centimetres(cell):>26s}" for cell in stills))
    for title, only_begun in (("still, said to move", False), ("the same, by pushes begun", True)):
        shares = [_share_of_phantoms(errors, only_begun) for errors in table.values()]
        print(f"{title:28s}" + "".join(f"{share:>26s}" for share in shares))


def draw(tables: dict[int, Table], path: Path) -> None:
    """Mean errors by group, a row per horizon, the floor behind them."""
    figure, axes = plt.subplots(len(tables), 1, figsize=(12, 7), layout="constrained")
    for ax, (ahead, table) in zip(axes, tables.items(), strict=True):
        order = ["all", "hit", "graze", "miss"]
        groups = [*order, *sorted(set(table["hidden"].moved) - set(order))]
        places = np.arange(len(groups))
        models = list(dict.fromkeys(who.partition(":")[0] for who in table if ":" in who))
        for number, who in enumerate(table):
            means = [100 * float(np.mean(table[who].moved.get(group, [np.nan]))) for group in groups]
            width, (model, _, part) = 0.8 / len(table), who.partition(": ")
            color = (
                f"C{models.index(model)}"
                if part
                else {"hidden": "0.3", "place": "0.5", "facets": "0.65", "camera": "0.85"}[who]
            )
            place = places + (number - (len(table) - 1) / 2) * width
            ax.bar(place, means, width, label=who, color=color, alpha=0.45 if part == "h" else 1.0)
        ax.set_xticks(places, [group.replace("_", " ") for group in groups], rotation=30, ha="right")
        ax.set_ylabel("mean error of moved objects, cm")
        ax.set_title(f"After {ahead} {'push' if ahead == 1 else 'pushes'}", loc="left")
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_ylim(top=1.2 * ax.get_ylim()[1])
        ax.legend(frameon=False, ncols=len(table), loc="upper center")
    figure.savefig(path, dpi=120)


def _share_of_phantoms(errors: Errors, only_begun: bool) -> str:
    """Of objects that lay still, those of which the predictor says that they move."""
    counted = [phantom for phantom, begun in zip(errors.phantoms, errors.begun, strict=True) if begun or not only_begun]
    return f"{np.mean(counted):.2%} ({sum(counted)} of {len(counted)})" if counted else "-"


def _centimetres(values: Sequence[float]) -> str:
    return f"{100 * float(np.mean(values)):.2f} / {100 * float(np.median(values)):.2f}" if len(values) else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoints", nargs="*", default=["cavin"])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=20000)
    parser.add_argument("--redraws", type=int, default=8)
    parser.add_argument("--place-error", type=float, default=0.0018, help="metres (%(default)s)")
    parser.add_argument("--objects", type=int, nargs=2, default=(1, OBJECT_SLOTS), help="at least, and at most")
    parser.add_argument("--neighbours", type=int, nargs="+", default=(None,))
    parser.add_argument("--policy", choices=POLICIES, default="heuristic", help="what chooses the pushes")
    parser.add_argument("--pusher", help="the checkpoint of --policy model")
    parser.add_argument("--object-set", default=WorldConfig.objects, help="as env.objects (%(default)s)")
    parser.add_argument("--assets", default=WorldConfig.assets, help="as env.assets")
    parser.add_argument("--camera", default=WorldConfig.camera, help="as env.camera (%(default)s)")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    fewest, most = arguments.objects
    chooser = {"policy": arguments.policy, "checkpoint": arguments.pusher}
    world = {name: getattr(arguments, name) for name in ("object_set", "assets", "camera")}
    config = CollectionConfig(seed=arguments.seed, minimum_objects=fewest, maximum_objects=most, **chooser, **world)
    check_policy(config)
    episodes = []
    with (
        closing(open_scene(config)) as scene,
        closing(open_scene(config)) as twin,
        progress_bar("pushing", total=arguments.episodes, unit="episode") as bar,
    ):
        for number in range(arguments.episodes):
            episodes.append(play(scene, twin, config, number, arguments.redraws, arguments.place_error))
            bar.update()
    paths = arguments.checkpoints or ["cavin"]
    found = [predictions(path, episodes, near) for path in paths for near in arguments.neighbours]
    tables = {
        ahead: measure(episodes, ahead, {who: rows for one in found for who, rows in one[ahead].items()})
        for ahead in (1, T)
    }
    for ahead, table in tables.items():
        show(table, ahead)
    if arguments.picture:
        draw(tables, arguments.picture)


if __name__ == "__main__":
    main()
