"""Enumeration in a user's model, closed-form divergences, and what of both is refused."""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pytest
import torch
from pyro import poutine
from pyro.distributions import Normal
from pyro.infer import Trace_ELBO, TraceEnum_ELBO, TraceMeanField_ELBO

from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.model import sequence_mask, windows_plate
from cavin_pyro.models.priors.conditional import ConditionalPrior
from cavin_pyro.models.state import Window
from cavin_pyro.training.compatibility import check_compatibility
from cavin_pyro.training.elbo import elbo_terms, window_terms
from cavin_pyro.training.objectives import Objective
from tests.guides.conftest import _random_window as random_window
from tests.guides.programs import PAIRS, make, make_model
from tests.guides.user_programs import InferredKindsGuide, KindsGuide, KindsModel

ENUMERATION = TraceEnum_ELBO(max_plate_nesting=1)


@pytest.fixture
def window() -> Window:
    return random_window().map(lambda field: field.double() if field.is_floating_point() else field)


@pytest.fixture
def kinds() -> KindsModel:
    return KindsModel(space=SPACE, feature_dimension=6, width=8, motion_dimension=4).double()


def given(kind: int, model: KindsModel) -> Callable[..., object]:
    return poutine.condition(model, data={"kind": torch.tensor(kind)})


def test_an_enumerated_site_needs_no_guide_and_is_summed_out_exactly(kinds: KindsModel, window: Window) -> None:
    guide = KindsGuide(kinds, width=8).double()
    check_compatibility(kinds, guide, window, ENUMERATION)
    torch.manual_seed(3)
    loss = Objective(ENUMERATION).loss(kinds, guide)(window, 0)
    torch.manual_seed(3)
    terms = elbo_terms(kinds, guide, window)
    assert {"kl_kind", "kl_motion_code", "nll_actions"} <= set(terms)
    each = []
    for kind in (0, 1):
        torch.manual_seed(3)
        each.append(-sum(window_terms(given(kind, kinds), guide, window).values()))
    expected = torch.stack(each).logsumexp(0).where(window.sequence_mask, each[0])
    assert sum(terms.values()).item() == pytest.approx(-expected.sum().item(), rel=1e-9)
    assert sum(terms.values()).item() == pytest.approx(loss.item(), rel=1e-9)
    wanted, gradients = (torch.autograd.grad(total, kinds.logits) for total in (loss, sum(terms.values())))
    assert torch.allclose(*wanted, *gradients) and wanted[0].abs().min() > 0
    several = window_terms(kinds, guide, window, particles=5)
    assert several["kl_kind"].shape == several["nll_actions"].shape == (5, 4) and not several["kl_kind"][:, 1].any()


def test_a_guide_may_infer_the_discrete_site_instead(kinds: KindsModel, window: Window) -> None:
    guide = InferredKindsGuide(kinds, width=8).double()
    check_compatibility(kinds, guide, window, Trace_ELBO())
    assert Objective(Trace_ELBO()).loss(kinds, guide)(window, 0).isfinite()
    with pytest.raises(UserError, match="KindsModel enumerates kind, which the guide lacks: choose objective.elbo"):
        check_compatibility(kinds, KindsGuide(kinds, width=8).double(), window, Trace_ELBO())


def test_a_model_that_observes_where_it_generates_is_refused(window: Window) -> None:
    class Fixed(KindsModel):
        def forward(self, window: Window) -> None:
            super().forward(window)
            pyro.sample("more", Normal(0.0, 1.0), obs=torch.tensor(0.0))

    model = Fixed(space=SPACE, feature_dimension=6, width=8, motion_dimension=4).double()
    with pytest.raises(UserError, match="model Fixed observes more where it generates: write obs=window.observed"):
        check_compatibility(model, KindsGuide(model, width=8).double(), window, ENUMERATION)


class MotionFirst(CascadedGuide):
    """z ~ q(z | s, a), c ~ q(c | s, s') moved by z: in the other order than the model's."""

    def forward(self, window: Window) -> None:
        encoded = self.model.encode(window)
        with windows_plate(window), sequence_mask(window):
            z = pyro.sample("motion_code", self.motion_inference(encoded[:, 0], window.first, window.actions))
            c = self.effect_inference(window.first, window.last).base_dist
            pyro.sample("effect_code", Normal(c.loc + 3 * z.sum(-1, keepdim=True), c.scale).to_event(1))


def divergence(elbo: type[Trace_ELBO], programs: tuple, window: Window) -> torch.Tensor:
    """Of one window, in nats, from 4,096 particles: the part of the bound that does not score what was observed."""
    torch.manual_seed(0)
    model, guide = (poutine.block(program, hide=list(SITES)) for program in programs)
    particles = {"num_particles": 4096, "vectorize_particles": True, "max_plate_nesting": 1}
    return elbo(**particles).differentiable_loss(model, guide, window)


SITES = ("actions", "subgoal_centers", "subgoal_features", "next_centers", "next_features")


def conditional(guide: str | type[CascadedGuide]) -> tuple:
    """A cascade whose p(z | s, c) depends on c, with a guide."""
    torch.manual_seed(1)
    prior = ConditionalPrior(space=SPACE, dimension=4, feature_dimension=6, effect_dimension=5, width=8)
    torch.nn.init.normal_(prior.code.head.weight, std=0.5)
    if isinstance(guide, str):
        programs = make("cascaded", guide, motion_prior=prior)
    else:
        model = make_model("cascaded", motion_prior=prior)
        programs = model, guide(model, width=8, motion_reads_effect=False)
    return tuple(program.double() for program in programs)


@torch.no_grad()
@pytest.mark.parametrize("pair", [pair for pair in PAIRS if pair[1] != "none"], ids="-".join)
def test_closed_form_divergences_are_those_of_samples(pair: tuple[str, str], window: Window) -> None:
    programs = conditional(pair[1]) if pair[0] == "cascaded" else tuple(one.double() for one in make(*pair))
    check_compatibility(*programs, window, TraceMeanField_ELBO())
    sampled, closed = (divergence(elbo, programs, window).item() for elbo in (Trace_ELBO, TraceMeanField_ELBO))
    assert closed == pytest.approx(sampled, abs=0.5, rel=0.01)


@torch.no_grad()
@pytest.mark.filterwarnings("ignore:Failed to verify mean field")
def test_another_order_than_the_models_has_other_divergences_and_is_refused(window: Window) -> None:
    programs = conditional(MotionFirst)
    sampled, closed = (divergence(elbo, programs, window).item() for elbo in (Trace_ELBO, TraceMeanField_ELBO))
    assert abs(sampled - closed) > 5
    check_compatibility(*programs, window, Trace_ELBO())
    with pytest.raises(UserError, match="samples motion_code, effect_code in this order, the model effect_code"):
        check_compatibility(*programs, window, TraceMeanField_ELBO())
