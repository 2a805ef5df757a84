"""Every tool of Pyro on every program: what docs/reference/pyro.md says of it, which is checked here cell by cell."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyro
import pytest
import torch
from pyro import infer, poutine
from pyro.contrib.gp.kernels import RBF
from pyro.distributions.transforms import Planar
from pyro.infer import autoguide
from pyro.infer.reparam import LocScaleReparam

from cavin_pyro.training.objectives import as_objective
from cavin_pyro.training.renyi import DifferentiableRenyiELBO
from guides.automatic import AutomaticGuide
from guides.cascaded import CascadedGuide
from guides.flat import FlatGuide
from guides.guide import Guide
from guides.none import NoGuide
from guides.single_latent import SingleLatentGuide
from models.cascaded import CascadedModel
from models.dynamics_only import DynamicsModel
from models.flat import FlatModel
from models.model import Model
from models.single_latent import SingleLatentModel
from models.state import Window
from tests.guides.pairs import make

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "pyro.md"
PROGRAMS: dict[str, tuple[type[Model], type[Guide]]] = {
    "cascaded": (CascadedModel, CascadedGuide),
    "single_latent": (SingleLatentModel, SingleLatentGuide),
    "flat": (FlatModel, FlatGuide),
    "dynamics": (DynamicsModel, NoGuide),
}
Tool = Callable[[Model, Guide, Window], Any]
WORKS, NOTHING = "works", "works, on no site"


def objective(make_bound: Callable[[], Any]) -> Tool:
    """A bound as `objective.elbo._target_` of train: its loss has gradients for the networks."""

    def run(model: Model, guide: Guide, window: Window) -> None:
        chosen = as_objective(make_bound())
        chosen.check(model, guide)
        bound = chosen.bind(model, guide)
        bound(window, 0).backward()
        moved = [
            parameter.grad is not None and bool(parameter.grad.abs().sum() > 0) for parameter in bound.parameters()
        ]
        assert sum(moved) > len(moved) / 2

    return run


def bound(kind: Any, **options: Any) -> Tool:
    return objective(partial(kind, **{"max_plate_nesting": 1, **options}))


def automatic(kind: Any, **options: Any) -> Tool:
    """An automatic guide as `guide.autoguide._target_` of train."""

    def run(model: Model, guide: Guide, window: Window) -> None:
        own = AutomaticGuide(model, autoguide=partial(kind, **options))
        own(window)
        assert list(own.parameters())
        bound(infer.Trace_ELBO)(model, own, window)

    return run


def in_store(tool: Tool) -> Tool:
    """With Pyro's global store of parameters, its default."""

    def run(model: Model, guide: Guide, window: Window) -> Any:
        with pyro.settings.context(module_local_params=False):
            return tool(model, guide, window)

    return run


def svi(model: Model, guide: Guide, window: Window) -> None:
    before = [parameter.detach().clone() for parameter in model.parameters()]
    infer.SVI(model, guide, adam(), infer.Trace_ELBO()).step(window)
    assert any(not torch.equal(*pair) for pair in zip(before, model.parameters(), strict=True))


def svgd(model: Model, guide: Guide, window: Window) -> None:
    infer.SVGD(model, infer.RBFSteinKernel(), adam(), num_particles=2, max_plate_nesting=1).step(window)


def adam() -> Any:
    return pyro.optim.Adam({"lr": 1e-2})


def chain(kernel: Callable[[Model], Any]) -> Tool:
    def run(model: Model, guide: Guide, window: Window) -> str:
        sampler = infer.MCMC(
            kernel(model.requires_grad_(False).eval()), num_samples=2, warmup_steps=1, disable_progbar=True
        )
        sampler.run(window)
        samples = sampler.get_samples()
        assert set(samples) == set(model.codes)
        assert all(bool(value.isfinite().all()) for value in samples.values())
        return WORKS if samples else NOTHING

    return run


def predict(model: Model, guide: Guide, window: Window) -> None:
    for options in ({}, {"guide": guide, "parallel": True}):
        sampled = infer.Predictive(model, num_samples=3, **options)(window, generate=True)
        assert sampled["next_centers"].shape == (3, *window.states.centers[:, 1:].shape)


def predict_weighed(model: Model, guide: Guide, window: Window) -> None:
    predictive = infer.WeighedPredictive(model, guide=guide, num_samples=3, parallel=True)
    assert predictive(window, model_guide=model).log_weights.shape == (3,)


def importance(model: Model, guide: Guide, window: Window) -> None:
    assert infer.Importance(model, guide, num_samples=3).run(window).get_log_normalizer().isfinite()


def reparameterise(model: Model, guide: Guide, window: Window) -> str:
    config = {name: LocScaleReparam(0.0) for name in model.codes}
    trace = poutine.trace(poutine.reparam(model, config=config)).get_trace(window)
    assert all(f"{name}_decentered" in trace.nodes for name in model.codes)
    return WORKS if model.codes else NOTHING


def enumerate_discrete(model: Model, guide: Guide, window: Window) -> str:
    marked = poutine.trace(infer.config_enumerate(model)).get_trace(window)
    assert not [name for name in marked.stochastic_nodes if marked.nodes[name]["infer"].get("enumerate")]
    return NOTHING


def changed(handler: Any) -> Tool:
    """Generation reads the value that a code, or else the first next centers, is set to."""

    def run(model: Model, guide: Guide, window: Window) -> None:
        site = (*model.codes, "next_centers_1")[0]
        shape = poutine.trace(model).get_trace(window, generate=True).nodes[site]["value"].shape
        results = []
        for value in (0.0, 0.0, 3.0):
            torch.manual_seed(0)
            program = handler(model, data={site: torch.full(shape, value)})
            results.append(poutine.trace(program).get_trace(window, generate=True).nodes["next_centers_2"]["value"])
        assert torch.equal(results[0], results[1])
        assert not torch.equal(results[0], results[2])

    return run


def changed_record(handler: Any) -> Tool:
    def run(model: Model, guide: Guide, window: Window) -> None:
        values = torch.zeros_like(window.states.centers[:, 1:])
        handler(model, data={"next_centers": values})(window, generate=True)

    return run


def render(model: Model, guide: Guide, window: Window) -> None:
    drawn = pyro.render_model(model, model_args=(window,)).source
    assert all(name in drawn for name in (*model.codes, "next_centers"))


def dependencies(model: Model, guide: Guide, window: Window) -> None:
    found = infer.inspect.get_dependencies(model, (window,))["prior_dependencies"]
    assert set(model.codes) <= set(found)


STEP: dict[str, Any] = {"step_size": 1e-3, "adapt_step_size": False}
SILENT = {"strict_enumeration_warning": False}
PARTICLES = {"num_particles": 2, "vectorize_particles": True}
TOOLS: dict[str, Tool] = {
    "Trace_ELBO": bound(infer.Trace_ELBO),
    "TraceMeanField_ELBO": bound(infer.TraceMeanField_ELBO),
    "TraceGraph_ELBO": bound(infer.TraceGraph_ELBO),
    "TraceEnum_ELBO": bound(infer.TraceEnum_ELBO, **SILENT),
    "TraceTMC_ELBO": bound(infer.TraceTMC_ELBO, **SILENT),
    "RenyiELBO": bound(infer.RenyiELBO, **PARTICLES),
    "DifferentiableRenyiELBO": bound(DifferentiableRenyiELBO, **PARTICLES),
    "TraceTailAdaptive_ELBO": bound(infer.TraceTailAdaptive_ELBO, **PARTICLES),
    "ReweightedWakeSleep": bound(infer.ReweightedWakeSleep, **PARTICLES),
    "Trace_MMD": objective(lambda: infer.Trace_MMD(kernel=RBF(input_dim=2), **PARTICLES)),
    "JitTrace_ELBO": bound(infer.JitTrace_ELBO),
    "JitTraceMeanField_ELBO": bound(infer.JitTraceMeanField_ELBO),
    "JitTraceGraph_ELBO": bound(infer.JitTraceGraph_ELBO),
    "JitTraceEnum_ELBO": bound(infer.JitTraceEnum_ELBO, **SILENT),
    "EnergyDistance": objective(infer.EnergyDistance),
    "SVI": in_store(svi),
    "AutoDelta": automatic(autoguide.AutoDelta),
    "AutoNormal": automatic(autoguide.AutoNormal),
    "AutoDiagonalNormal": automatic(autoguide.AutoDiagonalNormal),
    "AutoMultivariateNormal": automatic(autoguide.AutoMultivariateNormal),
    "AutoLowRankMultivariateNormal": automatic(autoguide.AutoLowRankMultivariateNormal),
    "AutoIAFNormal": automatic(autoguide.AutoIAFNormal),
    "AutoNormalizingFlow": automatic(autoguide.AutoNormalizingFlow, init_transform_fn=Planar),
    "AutoLaplaceApproximation": automatic(autoguide.AutoLaplaceApproximation),
    "AutoStructured": automatic(autoguide.AutoStructured),
    "AutoGaussian": automatic(autoguide.AutoGaussian),
    "AutoNormalMessenger": automatic(autoguide.AutoNormalMessenger),
    "AutoHierarchicalNormalMessenger": automatic(autoguide.AutoHierarchicalNormalMessenger),
    "AutoRegressiveMessenger": automatic(autoguide.AutoRegressiveMessenger),
    "AutoDiscreteParallel": automatic(autoguide.AutoDiscreteParallel),
    "Predictive": predict,
    "WeighedPredictive": predict_weighed,
    "Importance": importance,
    "NUTS": chain(lambda model: infer.NUTS(model, max_tree_depth=2, **STEP)),
    "HMC": chain(lambda model: infer.HMC(model, num_steps=2, **STEP)),
    "RandomWalkKernel": chain(infer.RandomWalkKernel),
    "SVGD": in_store(svgd),
    "CSIS": in_store(
        lambda model, guide, window: infer.CSIS(model, guide, adam(), num_inference_samples=2).step(
            window, generate=True
        )
    ),
    "condition": changed(poutine.condition),
    "do": changed(poutine.do),
    "condition next_centers": changed_record(poutine.condition),
    "do next_centers": changed_record(poutine.do),
    "LocScaleReparam": reparameterise,
    "config_enumerate": enumerate_discrete,
    "render_model": render,
    "get_dependencies": dependencies,
}


@pytest.fixture
def counted(random_window: Callable[..., Window]) -> Window:
    window = random_window(objects=2)
    return window._replace(sequence_mask=torch.ones(4, dtype=torch.bool))


def outcome(name: str, program: str, window: Window) -> str:
    """`works`, or the first line of what the tool raises, with TOOL for its name."""
    pyro.clear_param_store()
    torch.manual_seed(0)
    model, guide = make(*PROGRAMS[program])
    try:
        return TOOLS[name](model, guide, window) or WORKS
    except (AttributeError, IndexError, NotImplementedError, RuntimeError, TypeError, ValueError) as error:
        return str(error).strip().splitlines()[0].replace(name, "TOOL")


def table() -> dict[str, list[str]]:
    """The rows of the page's tables: what each tool gives for each program, the lines in place of their letters."""
    rows, lines = {}, {}
    for row in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in row.strip().strip("|").split("|")]
        if len(cells) == 2 and re.fullmatch(r"[a-z]", cells[0]):
            lines[cells[0]] = cells[1].strip("`")
        elif len(cells) == 1 + len(PROGRAMS) and (tool := re.fullmatch(r"`([\w ]+)`", cells[0])):
            rows[tool[1]] = cells[1:]
    return {tool: [lines.get(cell, cell) for cell in cells] for tool, cells in rows.items()}


@pytest.mark.parametrize("name", TOOLS)
def test_the_page_says_what_the_tool_does_with_each_program(name: str, counted: Window) -> None:
    found = [outcome(name, program, counted) for program in PROGRAMS]
    assert table().get(name) == found


def test_the_page_leaves_out_none_of_pyros_bounds_and_automatic_guides() -> None:
    bounds = {name for name in infer.__all__ if name.endswith("ELBO") and name != "ELBO"}
    bases = {"AutoCallable", "AutoContinuous", "AutoGuide", "AutoGuideList", "AutoMessenger"}
    guides = {name for name in autoguide.__all__ if name.startswith("Auto")} - bases
    assert set(table()) == set(TOOLS) >= bounds | guides
