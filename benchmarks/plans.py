"""The flat problem for our MPC and for public planners: `python benchmarks/plans.py [--quick] [OPTION=VALUE ...]`.

30 pushes searched at once, with the same dynamics, reward and samples; crossing, sparse, three objects, the first
scene. Milliseconds per plan, wall time, all in turn, median and fastest; f eager and compiled (`planner.compile=true`,
which takes some minutes). Set OMP_NUM_THREADS for the number of threads. The public planners come with the extra
`benchmarks`; options are those of `evaluate`, such as `matmul_precision=bfloat16`. What a plan costs against its size:
benchmarks/growth.py.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.envs.tabletop.tasks import TaskReward
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.models.state import State
from cavin_pyro.planning import MpcPlanner, PlanningModel

HORIZON = 30
FEATURES = 64
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


def our_planner(one: EpisodeRunner, state: State) -> Callable[[], object]:
    reward = one.env.goal()
    return lambda: one.planner.plan(state, reward=reward, generators=[torch.Generator().manual_seed(0)])


def next_state(model: PlanningModel, state: State, action: Tensor) -> State:
    return model.next_state(state, action)


class FlatProblem:
    """f and the reward as functions of a flat state `[..., M * 67]`, as the public planners want them."""

    def __init__(self, one: EpisodeRunner) -> None:
        state = self.state = one.env.state(one.env.reset(seed=0)[0]).map(lambda field: field[None])
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few samples and no compilation, to see that it runs")
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE", help="of evaluate")
    arguments = parser.parse_intermixed_args()
    for count in [32] if arguments.quick else [1024, 8192]:
        actions = {}
        for way, compiled in [("eager", "false")] if arguments.quick else [("eager", "false"), ("compiled", "true")]:
            options = [*FLAT, f"planner.compile={compiled}", f"planner.samples={count}", *arguments.options]
            one = make_runner(compose("evaluate", *options))
            problem = FlatProblem(one)
            actions[f"ours, {way}"] = our_planner(one, problem.state)
            actions[f"pytorch_mppi, f {way}"] = mppi_planner(problem, count)
            actions[f"torchrl CEM, f {way}"] = cem_planner(problem, count)
        with torch.inference_mode():
            spent = milliseconds(actions, 8)
        for name, times in spent.items():
            print(f"{count:7d} samples  {name:25s} {statistics.median(times):8.1f} ({min(times):.1f})", flush=True)


if __name__ == "__main__":
    main()
