"""What a plan costs with more objects: `python benchmarks/many_objects.py [--objects 3 5 8 10] [--neighbours 4 9]`.

    python benchmarks/many_objects.py --objects 3 5 10 --neighbours 4 --nearest 0 2

Processor time per plan of crossing with 1,024 samples and sparse rewards, from the first images of the same six seeds
for every number of objects, all of them in turn in one process, medians of --repetitions. And what the sampled plans
are like: of 1,024 segments from the priors, how many objects h moves by more than 5 cm, in how many f moves one so far
by the pushes that g generates, how far f and h are apart (mean over objects, median over segments), and in how many of
the segments in which h moves the target f moves it by more than 3 cm. Each number of neighbours is `model.neighbours`;
the first is also that of scenes with fewer others. `--nearest` is `planner.nearest_objects`, 0 for all; what h moves
does not depend on it. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.data.observed import observed_points, observed_state
from cavin_pyro.evaluation.factory import make_runner
from models.cascaded import CascadedModel
from models.state import State
from planning import CavinPlanner
from planning.extensions.touchdown import ObservedPoints

SEEDS = range(10000, 10006)
SAMPLES = 1024
FAR, SOME = 0.05, 0.03  # metres


Scene = tuple[State, ObservedPoints]


def planner_and_scenes(
    objects: int, neighbours: int, nearest: int, overrides: list[str]
) -> tuple[CavinPlanner, list[Scene]]:
    """The planner of `planner=cavin`, and scenes as the camera sees them."""
    about = f"planner.nearest_objects={nearest or 'null'}"
    one = make_runner(compose("evaluate", "task=crossing", f"objects={objects}", about, *overrides))
    seen = [one.env.reset(seed=seed)[0] for seed in SEEDS]
    scenes = [(observed_state(observation, one.geometry), observed_points(observation)) for observation in seen]
    one.env.close()
    planner: CavinPlanner = one.planner  # type: ignore[assignment]
    for part in (planner.model.encoder, planner.model.dynamics):  # type: ignore[attr-defined]
        part.neighbours = neighbours
    return planner, scenes


def milliseconds(planner: CavinPlanner, scenes: list[Scene]) -> float:
    """Processor time per plan."""
    began = time.process_time()
    for number, (state, observed) in enumerate(scenes):
        planner.plan(state, [torch.Generator().manual_seed(number)], None, observed)
    return 1e3 * (time.process_time() - began) / len(scenes)


@torch.inference_mode()
def sampled_segments(model: CascadedModel, scenes: list[Scene]) -> tuple[float, float, float, float]:
    """Objects that h moves, how often f moves one, metres from f to h, how often f moves the target that h moves."""
    by_h, by_f, apart, targets = [], [], [], []
    for number, (state, _) in enumerate(scenes):
        torch.manual_seed(number)
        here = there = state.expand_plans(SAMPLES)
        effect = model.effect_prior(here).sample()
        subgoal = model.subgoal(here, effect)
        for action in model.actions(here, effect, model.motion_prior(here, effect).sample()).unbind(-2):
            there = model.next_state(there, action)
        moved_by_h, moved_by_f = ((one.centers - here.centers)[..., :2].norm(dim=-1) for one in (subgoal, there))
        by_h.append(float((moved_by_h > FAR).sum(-1).float().mean()))
        by_f.append(float((moved_by_f > FAR).any(-1).float().mean()))
        apart.append(float((there.centers - subgoal.centers)[..., :2].norm(dim=-1).mean(-1).median()))
        wanted = moved_by_h[..., 0] > FAR
        targets.append(float((moved_by_f[..., 0] > SOME)[wanted].float().mean()) if wanted.any() else 0.0)
    return statistics.mean(by_h), statistics.mean(by_f), statistics.mean(apart), statistics.mean(targets)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, nargs="+", default=[3, 5, 8, 10])
    parser.add_argument("--neighbours", type=int, nargs="+", default=[4, 9])
    parser.add_argument("--nearest", type=int, nargs="+", default=[2])
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--options", nargs="*", default=[], help="of the planner, such as planner.horizon=60")
    arguments = parser.parse_args()
    first = arguments.neighbours[0]
    cases = {
        (objects, near, nearest): planner_and_scenes(objects, near, nearest, arguments.options)
        for objects in arguments.objects
        for near in arguments.neighbours
        for nearest in arguments.nearest
        if near == first or objects > first + 1
    }
    times: dict[tuple[int, int, int], list[float]] = {case: [] for case in cases}
    for repetition in range(arguments.repetitions + 1):
        for case, parts in cases.items():
            spent = milliseconds(*parts)
            if repetition:  # the first warms up
                times[case].append(spent)
    print("objects  neighbours  nearest  ms per plan  moved by h  f moves one  f from h  target")
    for case, (planner, scenes) in cases.items():
        moved, share, apart, target = sampled_segments(planner.model, scenes)  # type: ignore[arg-type]
        spent = statistics.median(times[case])
        segments = f"{moved:10.2f}  {share:11.1%}  {100 * apart:5.1f} cm  {target:6.1%}"
        print(f"{case[0]:7d}  {case[1]:10d}  {case[2]:7d}  {spent:11.1f}  {segments}")


if __name__ == "__main__":
    main()
