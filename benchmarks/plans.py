"""The flat problem for our MPC and for a public planner: `python benchmarks/plans.py [OPTION=VALUE ...]`.

30 pushes searched at once, with the same dynamics, reward and samples; crossing, sparse, three objects, the first
scene. Milliseconds per plan, wall time, all in turn, median and fastest; f eager and compiled (`planner.compile=true`,
which takes some minutes). Set OMP_NUM_THREADS for the number of threads. The public planner comes with the extra
`benchmarks`; options are those of `evaluate`, such as `matmul_precision=bfloat16`.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.envs.tabletop.tasks import TaskReward
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.models.state import State
from cavin_pyro.planning import MpcPlanner, PlanningModel

HORIZON = 30
FLAT = ("planner=mpc", "task=crossing", "objects=3", f"planner.horizon={HORIZON}", "margin=0")  # the task's own reward


def milliseconds(actions: dict[str, Callable[[], object]], repetitions: int) -> dict[str, list[float]]:
    """Wall times of each action, all of them in turn, so that what else the machine does falls on all."""
    times: dict[str, list[float]] = {name: [] for name in actions}
    for repetition in range(repetitions + 1):
        for name, action in actions.items():
            began = time.perf_counter()
            action()
            if repetition:  # the first warms up
                times[name].append(1e3 * (time.perf_counter() - began))
    return times


def next_state(model: PlanningModel, state: State, action: Tensor) -> State:
    return model.next_state(state, action)


class FlatProblem:
    """f and the reward as functions of a flat state `[..., M * 67]`, as the public planner wants them."""

    def __init__(self, one: EpisodeRunner) -> None:
        state = self.state = one.env.state(one.env.reset(seed=0)[0]).map(lambda field: field[None])
        planner: MpcPlanner = one.planner  # type: ignore[assignment]
        self.model, self.backend, self.mask = planner.model, planner.backend, state.mask[0]
        self.reward = TaskReward(one.env.task)  # type: ignore[attr-defined]
        self.start = torch.cat((state.centers[0], state.features[0]), -1).flatten()

    def unpack(self, flat: Tensor) -> State:
        parts = flat.unflatten(-1, (len(self.mask), -1))
        return State(parts[..., :3], parts[..., 3:], self.mask.expand(parts.shape[:-1]))

    def step(self, flat: Tensor, action: Tensor) -> Tensor:
        after = self.backend(next_state, self.model, self.unpack(flat), action)
        return torch.cat((after.centers, after.features), -1).flatten(-2)

    def cost(self, flat: Tensor, action: Tensor) -> Tensor:
        """Of a state alone, as pytorch_mppi wants it: the reward of a sparse task needs no other."""
        state = self.unpack(flat)
        return -self.reward(state.centers, state.centers, state.mask).reward


def mppi_planner(problem: FlatProblem, samples: int) -> Callable[[], object]:
    from pytorch_mppi import MPPI

    options = {"num_samples": samples, "horizon": HORIZON, "u_min": -torch.ones(4), "u_max": torch.ones(4)}
    planner = MPPI(problem.step, problem.cost, len(problem.start), torch.eye(4) * 0.25, lambda_=1.0, **options)
    return partial(planner.command, problem.start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE", help="of evaluate")
    given = parser.parse_args().options
    for count in (1024, 8192):
        actions: dict[str, Callable[[], object]] = {}
        for way, compiled in ("eager", "false"), ("compiled", "true"):
            options = [*FLAT, f"planner.compile={compiled}", f"planner.samples={count}", *given]
            one, generators = make_runner(compose("evaluate", *options)), [torch.Generator().manual_seed(0)]
            problem, goal = FlatProblem(one), one.env.goal()
            actions[f"ours, {way}"] = partial(one.planner.plan, problem.state, reward=goal, generators=generators)
            actions[f"pytorch_mppi, f {way}"] = mppi_planner(problem, count)
        with torch.inference_mode():
            for name, times in milliseconds(actions, 8).items():
                print(f"{count:7d} samples  {name:25s} {statistics.median(times):8.1f} ({min(times):.1f})", flush=True)


if __name__ == "__main__":
    main()
