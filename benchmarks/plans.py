"""What a plan costs: `python benchmarks/plans.py [--quick]`.

Milliseconds per plan with the shipped checkpoint, eager and compiled (`planner.compile=true`), the floating-point
operations in it, and the share of this machine's own rate of float32 matrix products that planning reaches; then the
flat problem (30 pushes searched at once, the same dynamics, reward and samples) for our MPC and two public planners.
Wall time, all in turn, medians and the fastest; crossing, sparse, horizon 30, T = 3, the first scenes of 16 episodes,
planned one after another or all at once: how long a search goes on depends on the scene. "Algorithm 1" is compiled
planning without the addition `perturbed_rollouts`, which are not in the paper. Set OMP_NUM_THREADS for the
number of threads. Compiling takes a minute for each number of samples and of objects, a quarter of an hour in all. The
public planners come with the extra `benchmarks`; `--no-grid`, `--no-flat` and `--no-compile` leave things out, and
`--first` times the first compiled plan of a process. Options of `evaluate` come last, such as
`matmul_precision=bfloat16`.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from cavin_pyro.config.composition import compose
from cavin_pyro.envs.tabletop.tasks import TaskReward
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.models.state import State
from cavin_pyro.planning import MpcPlanner, Planner, PlanningModel, Reward
from cavin_pyro.planning.additions import PerturbedRollouts

HORIZON = 30
SCENES = 16  # also the larger batch
FEATURES = 64


def runner(objects: int, samples: int, *overrides: str) -> EpisodeRunner:
    shared = ["task=crossing", f"objects={objects}", f"planner.samples={samples}", f"planner.horizon={HORIZON}"]
    return make_runner(compose("evaluate", *overrides, *shared))


def scenes(one: EpisodeRunner, count: int) -> State:
    """`count` scenes as the camera sees them: [count, M, ...]."""
    states = [one.env.state(one.env.reset(seed=seed)[0]) for seed in range(count)]
    return State(*(torch.stack(field) for field in zip(*states, strict=True)))


def generators(count: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


class Times(NamedTuple):
    """Of repetitions, in milliseconds."""

    median: float
    fastest: float


def milliseconds(actions: dict[str, Callable[[], object]], repetitions: int) -> dict[str, Times]:
    """Wall time of each action, all of them in turn, so that what else the machine does falls on all."""
    times: dict[str, list[float]] = {name: [] for name in actions}
    for repetition in range(repetitions + 1):
        for name, action in actions.items():
            began = time.perf_counter()
            action()
            if repetition:  # the first warms up
                times[name].append(1e3 * (time.perf_counter() - began))
    return {name: Times(statistics.median(values), min(values)) for name, values in times.items()}


def planning(planner: Planner, state: State, reward: Reward, batch: int) -> Callable[[], object]:
    """Plans for all scenes, as many at once as `batch`."""

    def plan() -> None:
        sources = generators(len(state.centers))
        for begin in range(0, len(sources), batch):
            chunk = slice(begin, begin + batch)
            planner.plan(state.scene(chunk), reward=reward, generators=sources[chunk])

    return plan


def matrix_rate(size: int) -> float:
    """Floating-point operations per second of one product of large float32 matrices, whose factors are not rounded."""
    left, right = torch.rand(size, size), torch.rand(size, size)
    rounded = torch.get_float32_matmul_precision()  # as the planners have set it
    torch.set_float32_matmul_precision("highest")
    best = milliseconds({"product": lambda: left @ right}, 5)["product"].fastest
    torch.set_float32_matmul_precision(rounded)
    return 2 * size**3 / (best / 1e3)


def operations(action: Callable[[], object]) -> int:
    with FlopCounterMode(display=False) as counter:
        action()
    return counter.get_total_flops()


def planners(
    objects: int, samples: int, ways: list[str], options: list[str]
) -> tuple[dict[str, Planner], State, Reward]:
    """A planner for each of the `ways`, the scenes that they plan for, and their reward."""
    found: dict[str, Planner] = {}
    torch.compiler.reset()  # which keeps eight versions of a function
    for way in ways:
        one = runner(objects, samples, f"planner.compile={str(way == 'compiled').lower()}", *options)
        found[way], state, reward = one.planner, scenes(one, SCENES), one.env.goal()
        one.env.close()
    if "compiled" in found:
        plain: Any = copy.copy(found["compiled"])  # with what has been compiled
        plain.additions = [one for one in plain.additions if not isinstance(one, PerturbedRollouts)]
        found["Algorithm 1"] = plain
    return found, state, reward


def grid(
    samples: list[int], objects: list[int], repetitions: int, ways: list[str], *, size: int, options: list[str]
) -> None:
    """`size`: of the matrices whose product tells this machine's rate. `options`: of `evaluate`."""
    plain = ["Algorithm 1"] if "compiled" in ways else []
    print(f"{torch.get_num_threads()} thread(s); ms per plan, median (fastest), and what share of the matrix rate")
    titles = [*(f"{way:>15}  share" for way in ways), *(f"{way:>15}" for way in plain)]
    print("  ".join(["samples  objects  batch  GFLOP  matrix GFLOP/s", *titles]))
    for count in samples:
        for number in objects:
            found, state, reward = planners(number, count, ways, options)
            work = operations(planning(found["eager"], state, reward, 1)) / SCENES
            for batch in (1, SCENES):
                rate = matrix_rate(size)  # anew each time: where cores are shared, it changes by the minute
                actions = {way: planning(found[way], state, reward, batch) for way in (*ways, *plain)}
                figures = [f"{count:7d}  {number:7d}  {batch:5d}  {work / 1e9:5.2f}  {rate / 1e9:14.0f}"]
                for way, times in milliseconds(actions, repetitions if count < 8192 else 2).items():
                    median, fastest = times.median / SCENES, times.fastest / SCENES
                    share = f"  {work / (median / 1e3) / rate:5.2f}" if way in ways else ""
                    figures.append(f"{median:7.1f} ({fastest:5.1f}){share}")
                print("  ".join(figures), flush=True)


def first(objects: list[int], samples: int, options: list[str]) -> None:
    """The first compiled plan of this process: the first process compiles, later ones find torch's cache on disk."""
    for number in objects:
        one = runner(number, samples, "planner.compile=true", *options)
        state = scenes(one, 1)
        for name in ("first", "second"):
            began, spent = time.perf_counter(), time.process_time()
            planning(one.planner, state, one.env.goal(), 1)()
            took, spent = time.perf_counter() - began, time.process_time() - spent
            print(f"{number} objects, {name} plan: {took:.2f} s, of this process's processor {spent:.2f} s", flush=True)
        one.env.close()


def next_state(model: PlanningModel, state: State, action: Tensor) -> State:
    return model.next_state(state, action)


class FlatProblem:
    """f and the reward as functions of a flat state `[..., M * 67]`, as the public planners want them."""

    def __init__(self, one: EpisodeRunner, state: State) -> None:
        planner: MpcPlanner = one.planner  # type: ignore[assignment]
        self.model, self.backend, self.mask = planner.model, planner.backend, state.mask[0]
        self.reward = TaskReward(one.env.task)  # type: ignore[attr-defined]
        self.objects = state.objects
        self.start = torch.cat((state.centers[0], state.features[0]), -1).flatten()

    def unpack(self, flat: Tensor) -> State:
        parts = flat.unflatten(-1, (self.objects, 3 + FEATURES))
        return State(parts[..., :3], parts[..., 3:], self.mask.expand(parts.shape[:-1]))

    def step(self, flat: Tensor, action: Tensor) -> Tensor:
        after = self.backend(next_state, self.model, self.unpack(flat), action)
        return torch.cat((after.centers, after.features), -1).flatten(-2)

    def rewards(self, before: Tensor, after: Tensor) -> Tensor:
        state = self.unpack(after)
        return self.reward(self.unpack(before).centers, state.centers, state.mask).reward


def mppi_planner(problem: FlatProblem, samples: int) -> Callable[[], object]:
    from pytorch_mppi import MPPI

    planner = MPPI(
        problem.step,
        # Its costs see one state; the reward of a sparse task needs no other.
        lambda flat, action: -problem.rewards(flat, flat),
        len(problem.start),
        torch.eye(4) * 0.25,
        num_samples=samples,
        horizon=HORIZON,
        lambda_=1.0,
        u_min=-torch.ones(4),
        u_max=torch.ones(4),
    )
    return lambda: planner.command(problem.start)


def cem_planner(problem: FlatProblem, samples: int) -> Callable[[], object]:
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule, TensorDictSequential
    from torchrl.data import Bounded, Composite, Unbounded
    from torchrl.envs.model_based import ModelBasedEnvBase
    from torchrl.modules import CEMPlanner

    class World(ModelBasedEnvBase):
        def __init__(self) -> None:
            model = TensorDictSequential(
                TensorDictModule(problem.step, in_keys=["state", "action"], out_keys=["after"]),
                TensorDictModule(
                    lambda before, after: problem.rewards(before, after).unsqueeze(-1),
                    in_keys=["state", "after"],
                    out_keys=["reward"],
                ),
                TensorDictModule(lambda after: after, in_keys=["after"], out_keys=["state"]),
            )
            super().__init__(model, device="cpu", batch_size=[])
            self.observation_spec = Composite(state=Unbounded((len(problem.start),)))
            self.state_spec = Composite(state=Unbounded((len(problem.start),)))
            self.action_spec = Bounded(-1.0, 1.0, (4,))
            self.reward_spec = Unbounded((1,))

        def _reset(self, tensordict: TensorDict) -> TensorDict:
            return TensorDict({"state": problem.start.clone()}, batch_size=[])

        def _set_seed(self, seed: int | None) -> None:
            torch.manual_seed(seed or 0)

    world = World()
    planner = CEMPlanner(
        world, planning_horizon=HORIZON, optim_steps=1, num_candidates=samples, top_k=max(1, samples // 10)
    )
    start = world.reset()
    return lambda: planner(start.clone())


def flat(samples: list[int], repetitions: int, ways: list[str], options: list[str]) -> None:
    print("the flat problem, 3 objects: ms per plan; all call the same f, eager or compiled by torch")
    for count in samples:
        runners = {
            # No margin: all maximise the task's own reward.
            way: runner(
                3, count, "planner=mpc", "margin=0", f"planner.compile={str(way == 'compiled').lower()}", *options
            )
            for way in ways
        }
        ours, theirs = {}, {}
        for way, one in runners.items():
            problem = FlatProblem(one, scenes(one, 1))
            ours[f"ours, {way}"] = planning(one.planner, scenes(one, 1), one.env.goal(), 1)
            theirs[f"pytorch_mppi, f {way}"] = mppi_planner(problem, count)
            theirs[f"torchrl CEM, f {way}"] = cem_planner(problem, count)
        with torch.inference_mode():
            spent = milliseconds({**ours, **theirs}, repetitions)
        for name, (median, fastest) in spent.items():
            times = ", ".join(f"{median / spent[own].median:.2f}" for own in ours)
            ratios = "" if name in ours else f"; over ours {times}"
            print(f"{count:7d} samples  {name:25s} {median:8.1f} ({fastest:.1f}){ratios}", flush=True)
        for one in runners.values():
            one.env.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small part, to see that it runs")
    parser.add_argument("--no-grid", action="store_true", help="the public planners only")
    parser.add_argument("--no-flat", action="store_true", help="leave the public planners out")
    parser.add_argument("--no-compile", action="store_true", help="leave compiled planning out, and its compilations")
    parser.add_argument("--first", action="store_true", help="the first plan of a process only: give it twice")
    parser.add_argument("--samples", type=int, nargs="+", help="numbers of samples (256, 1024 and 8192 by default)")
    parser.add_argument("--objects", type=int, nargs="+", help="numbers of objects (1, 3 and 5 by default)")
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE", help="of evaluate")
    arguments = parser.parse_intermixed_args()
    ways = ["eager"] if arguments.no_compile else ["eager", "compiled"]
    samples, objects, repetitions = ([32], [2], 2) if arguments.quick else ([256, 1024, 8192], [1, 3, 5], 4)
    samples, objects = arguments.samples or samples, arguments.objects or objects
    if arguments.first:
        first(objects, arguments.samples[0] if arguments.samples else 1024, arguments.options)
        return
    if not arguments.no_grid:
        grid(samples, objects, repetitions, ways, size=512 if arguments.quick else 2048, options=arguments.options)
    if not arguments.no_flat:
        flat([32] if arguments.quick else [1024, 8192], 2 * repetitions, ways, arguments.options)


if __name__ == "__main__":
    main()
