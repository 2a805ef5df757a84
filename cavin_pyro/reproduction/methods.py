"""The four methods of the paper's figure, and CAVIN with our networks, each with its training and two planners."""

from __future__ import annotations

from dataclasses import dataclass

# The paper's way of planning, for the baselines as `planner=paper` has it for CAVIN.
WITHOUT_ADDITIONS = (
    "planner.additions=[]",
    "pushes_per_plan=null",
    "push_decimals=null",
    "margin=0",
    "matmul_precision=float32",
)


@dataclass(frozen=True)
class Method:
    """A method. training: overrides of `train`. planners: overrides of `evaluate`, by kind of planner.

    tuned: further overrides of `train` with a learned prior; with N(0, I) codes have the paper's dimensions.
    in_paper: whether the paper has it. The paper's claims, and the correction of its comparisons, are about those.
    """

    label: str
    color: str
    training: tuple[str, ...]
    planners: dict[str, tuple[str, ...]]
    tuned: tuple[str, ...] = ()
    in_paper: bool = True

    @property
    def reads_point_clouds(self) -> bool:
        """Whether its models read the features of a pretrained PointNet."""
        return not any(one.startswith("geometry=") for one in self.training)


METHODS = {
    "cavin": Method(
        "CAVIN",
        "#D55E00",
        ("model=cascaded", "guide=cascaded"),
        {"paper": ("planner=paper",), "ours": ("planner=cavin",)},
    ),
    "sectar": Method(
        "SeCTAR",
        "#0072B2",
        # Of 0.01, 0.1, 1 and 10 the weight with most successes on tuning scenes.
        ("model=single_latent", "guide=single_latent", "model.action_weight=0.1"),
        # More samples than the others' 1,024, so that it spends at least as many model evaluations as CAVIN.
        {"paper": ("planner=sectar", *WITHOUT_ADDITIONS), "ours": ("planner=sectar", "planner.samples=1408")},
    ),
    "cvae_mpc": Method(
        "CVAE-MPC",
        "#009E73",
        ("model=flat", "guide=flat"),
        {"paper": ("planner=cvae_mpc", *WITHOUT_ADDITIONS), "ours": ("planner=cvae_mpc",)},
        tuned=("model.motion_dimension=16",),  # of 16, 32 (the paper) and 64 likewise
    ),
    "mpc": Method(
        "MPC",
        "#7F7F7F",
        ("model=dynamics", "guide=none", "prior=standard"),
        {"paper": ("planner=mpc", *WITHOUT_ADDITIONS), "ours": ("planner=mpc",)},
    ),
    "contact": Method(
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
}
