"""Pyro's automatic guides by option: posteriors of a fixed set of windows, as numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from pyro.infer import Trace_ELBO
from pyro.infer.autoguide import AutoIAFNormal, AutoLowRankMultivariateNormal, AutoNormal, AutoStructured

from cavin_pyro.guides.automatic import AutomaticGuide
from cavin_pyro.models.state import Window
from cavin_pyro.training.elbo import elbo_terms
from tests.guides.programs import make_model


@pytest.fixture
def counted(random_window: Callable[..., Window]) -> Window:
    """Windows that all count."""
    window = random_window(batch=6)
    return window._replace(sequence_mask=torch.ones(6, dtype=torch.bool))


@pytest.mark.parametrize(
    ("model", "family"),
    [
        *(("cascaded", family) for family in (AutoNormal, AutoLowRankMultivariateNormal, AutoIAFNormal)),
        ("single_latent", AutoNormal),
        ("flat", AutoStructured),
    ],
)
def test_its_terms_are_those_of_pyros_bound_and_it_learns(
    model: str, family: type[AutoNormal], counted: Window
) -> None:
    program = make_model(model)
    guide = AutomaticGuide(program, autoguide=partial(family))
    guide(counted)
    loss = Trace_ELBO(max_plate_nesting=1)(program, guide)
    torch.manual_seed(3)
    expected = loss(counted).item()
    torch.manual_seed(3)
    terms = elbo_terms(program, guide, counted)
    assert sum(term.item() for term in terms.values()) == pytest.approx(expected, rel=1e-5)
    assert {name for name in terms if name.startswith("kl_")} >= {f"kl_{code}" for code in program.codes}
    optimizer = torch.optim.Adam(guide.parameters(), lr=1e-2)
    for _ in range(15):
        optimizer.zero_grad()
        loss(counted).backward()
        optimizer.step()
    torch.manual_seed(3)
    assert loss(counted).item() < expected


def test_it_has_parameters_for_each_window_and_none_for_others(counted: Window) -> None:
    guide = AutomaticGuide(make_model("cascaded"), autoguide=partial(AutoNormal))
    guide(counted)
    assert {tuple(parameter.shape) for parameter in guide.parameters()} == {(6, 5), (6, 4)}
    for other in (counted.map(lambda field: field[:2]), counted.map(lambda field: field.flip(0))):
        with pytest.raises(ValueError, match="has parameters for 6 windows, and these are others"):
            guide(other)


def test_unsuitable_windows_models_and_classes_are_refused(random_window: Callable[..., Window]) -> None:
    with pytest.raises(ValueError, match="takes windows that all count"):
        AutomaticGuide(make_model("cascaded"), autoguide=partial(AutoNormal))(random_window())
    with pytest.raises(ValueError, match="guide AutomaticGuide does not fit model DynamicsModel"):
        AutomaticGuide(make_model("dynamics"), autoguide=partial(AutoNormal))
    with pytest.raises(ValueError, match="which is no torch module"):
        AutomaticGuide(make_model("cascaded"), autoguide=lambda model: 3)
