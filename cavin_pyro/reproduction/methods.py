"""The four methods of the paper's figure, and CAVIN with our networks, each with its training and two planners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import DictConfig

# The paper's way of planning, for the baselines as `planner=paper` has it for CAVIN.
WITHOUT_ADDITIONS = (
    "planner.warm_start=false",
    "planner.robustness=null",
    "planner.idle_distance=0.0",
    "planner.touchdown_distance=0.0",
    "pushes_per_plan=null",
    "push_decimals=null",
    "margin=0",
    "matmul_precision=float32",
)


@dataclass(frozen=True)
class Method:
    """A method. label: in figures. training: overrides of `train`. planners: overrides of `evaluate`, by planner.

    in_paper: whether the paper has it. The paper's claims, and the correction of its comparisons, are about those.
    """

    name: str
    label: str
    color: str
    training: tuple[str, ...]
    planners: dict[str, tuple[str, ...]]
    in_paper: bool = True

    @property
    def reads_point_clouds(self) -> bool:
        """Whether its models read the features of a pretrained PointNet."""
        return not any(one.startswith("geometry=") for one in self.training)


METHODS: dict[str, Method] = {
    one.name: one
    for one in (
        Method(
            "cavin",
            "CAVIN",
            "#D55E00",
            ("model=cascaded", "guide=cascaded"),
            {
                "paper": ("planner=paper",),
                "ours": ("planner=cavin",),
                "first_segment": ("planner=paper", "planner.motion_horizon=first_segment"),
                "one_motion": ("planner=paper", "planner.motion_samples=1"),
                "without_effects": ("planner=cavin_without_effects", *WITHOUT_ADDITIONS),
            },
        ),
        Method(
            "sectar",
            "SeCTAR",
            "#0072B2",
            # Of 0.01, 0.1, 1 and 10 the one with most successes on tuning scenes.
            ("model=single_latent", "guide=single_latent", "model.action_weight=0.1"),
            {
                "paper": ("planner=sectar", *WITHOUT_ADDITIONS),
                # More samples than the others' 1,024, so that it spends at least as many model evaluations as CAVIN.
                "ours": ("planner=sectar", "planner.samples=1408"),
                "perturbed_rollouts": (
                    "planner=sectar",
                    *(one for one in WITHOUT_ADDITIONS if not one.startswith("planner.robustness")),
                ),
            },
        ),
        Method(
            "cvae_mpc",
            "CVAE-MPC",
            "#009E73",
            # Chosen as SeCTAR's; the paper has 32.
            ("model=flat", "guide=flat", "model.motion_dimension=16"),
            {"paper": ("planner=cvae_mpc", *WITHOUT_ADDITIONS), "ours": ("planner=cvae_mpc",)},
        ),
        Method(
            "mpc",
            "MPC",
            "#7F7F7F",
            ("model=dynamics", "guide=none", "prior=standard"),
            {"paper": ("planner=mpc", *WITHOUT_ADDITIONS), "ours": ("planner=mpc",)},
        ),
        Method(
            "contact",
            "CAVIN, contact",
            "#CC79A7",
            (
                *("model=cascaded", "guide=cascaded", "prior=mixture"),
                *("geometry=outline", "dynamics=contact", "dynamics.equivariant=true", "scales=predicted"),
                "objective=rollout",
                *("trainer.reflect=true", "trainer.learning_rate=2e-3", "trainer.clip_norm=10000"),
            ),
            {"paper": ("planner=paper",), "ours": ("planner=cavin",)},
            in_paper=False,
        ),
    )
}
PAPER_METHODS = [one.name for one in METHODS.values() if one.in_paper]


def chosen_methods(config: DictConfig) -> Sequence[str]:
    """The option `methods`; by default the paper's, and all there are where a table is drawn."""
    default = list(METHODS) if config.table else PAPER_METHODS
    return default if config.methods is None else list(config.methods)
