from __future__ import annotations

from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor
from torch.nn import functional

from cavin_pyro.training.elbo import elbo_terms, first_nonfinite, term_counts
from models.state import State, Window

LATENT = {"nll_subgoal_centers", "nll_subgoal_features", "nll_actions", "kl_effect_code", "kl_motion_code"}
DYNAMICS = {"nll_next_centers", "nll_next_features"}


def window(batch: int = 6) -> Window:
    """Some windows and transitions do not count, and one object is padding."""
    centers = torch.rand(batch, 4, 5, 3, dtype=torch.float64)
    features = functional.normalize(torch.randn(batch, 4, 5, 64, dtype=torch.float64), dim=-1)
    mask = (torch.arange(5) < 4).expand(batch, 4, 5)
    transition_mask = torch.arange(3 * batch).reshape(batch, 3) % 4 != 1
    actions = torch.rand(batch, 3, 4, dtype=torch.float64)
    return Window(State(centers, features, mask), actions, transition_mask, torch.arange(batch) % 3 != 1)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_terms_sum_to_pyros_loss_with_the_same_noise(seed: int, small: SimpleNamespace) -> None:
    parts = small.parts(seed)
    model, guide = parts["model"].double(), parts["guide"].double()
    batch = window()
    torch.manual_seed(seed)
    loss = Trace_ELBO().loss(model, guide, batch)
    torch.manual_seed(seed)
    terms = elbo_terms(model, guide, batch)
    assert terms.keys() == LATENT | DYNAMICS
    assert sum(value.item() for value in terms.values()) == pytest.approx(loss, rel=1e-12)
    gradients = torch.autograd.grad(sum(terms.values(), torch.zeros(())), list(model.parameters()))
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


def test_terms_count_for_windows_or_for_transitions() -> None:
    batch = window()
    assert (int(batch.sequence_mask.sum()), int(batch.transition_mask.sum())) == (4, 13)
    counts = term_counts(LATENT | DYNAMICS, batch)
    assert counts == {**dict.fromkeys(LATENT, 4), **dict.fromkeys(DYNAMICS, 13)}


def test_a_batch_in_which_nothing_counts_costs_nothing(small: SimpleNamespace) -> None:
    parts = small.parts()
    batch = window()
    nothing = batch._replace(
        transition_mask=torch.zeros_like(batch.transition_mask),
        sequence_mask=torch.zeros_like(batch.sequence_mask),
    )
    terms = elbo_terms(parts["model"].double(), parts["guide"].double(), nothing)
    assert {value.item() for value in terms.values()} == {0.0}
    assert term_counts(terms, nothing) == dict.fromkeys(terms, 0)


def test_the_first_term_that_is_not_finite_is_found() -> None:
    terms: dict[str, Tensor] = {name: torch.tensor(float(number)) for number, name in enumerate("abc")}
    assert first_nonfinite(terms) is None
    assert first_nonfinite({**terms, "b": torch.tensor(torch.nan), "c": torch.tensor(torch.inf)}) == "b"
    assert first_nonfinite({**terms, "c": torch.tensor(-torch.inf)}) == "c"


def test_terms_leave_no_parameters_in_pyros_store(small: SimpleNamespace) -> None:
    parts = small.parts()
    elbo_terms(parts["model"].double(), parts["guide"].double(), window())
    assert not pyro.get_param_store().keys()
