"""Model-guide compatibility, checked by their sites."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from pyro import poutine
from pyro.infer import ELBO, TraceEnum_ELBO, TraceMeanField_ELBO
from torch import nn

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.parts import PARTS
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import Window
from cavin_pyro.training.elbo import Sites, latent_sites, sampled_sites
from cavin_pyro.training.resume import forked


@user_input(*PARTS)
@torch.no_grad()
def check_compatibility(model: Model, guide: nn.Module, window: Window, elbo: ELBO) -> None:
    """Run both programs once and check that the guide has the sites of the model's codes, and no others.

    Pyro itself samples a code that the guide lacks from the prior, and counts sites that only the guide has. With
    `TraceEnum_ELBO` sites that are marked `infer={"enumerate": "parallel"}` need no guide. `window: [B]`, with B of at
    least 2, so that one of them can be masked. The random generator's state is restored afterwards.

    A `UserError` names a code that the guide lacks or the model does not have, one outside of the model's plates, of
    another shape, or counted where the model does not count it; codes in another order than the model's, where
    divergences in closed form need that; what a model observes where it generates; or a density that is not finite.
    """
    device = window.actions.device
    window = window._replace(sequence_mask=torch.arange(len(window.actions), device=device) == 0)
    with forked(device):
        wanted, sampled = _codes(model, window), _codes(guide, window)
        generated = sampled_sites(poutine.trace(model.generate).get_trace(window))
    known = [name for name, site in generated.items() if site["is_observed"] and "_deterministic" not in site["infer"]]
    if known:
        raise UserError(
            f"model {type(model).__name__} observes {', '.join(known)} where it generates: write "
            "obs=window.observed(...)"
        )
    name = f"guide {type(guide).__name__}"
    marked = {code for code, site in wanted.items() if site["infer"].get("enumerate") == "parallel"}
    enumerated = marked - sampled.keys()
    if isinstance(elbo, TraceEnum_ELBO):
        wanted = {code: site for code, site in wanted.items() if code not in enumerated}
    elif enumerated:
        raise UserError(
            f"model {type(model).__name__} enumerates {_listed(enumerated)}, which the guide lacks: choose "
            "objective.elbo._target_=pyro.infer.TraceEnum_ELBO"
        )
    if wanted.keys() != sampled.keys():
        raise UserError(
            f"{name} samples {_listed(sampled)}, but the codes of model {type(model).__name__} are {_listed(wanted)}: "
            "give each code, and nothing else, a pyro.sample"
        )
    if isinstance(elbo, TraceMeanField_ELBO) and [*wanted] != [*sampled]:
        raise UserError(
            f"{name} samples {', '.join(sampled)} in this order, the model {', '.join(wanted)}: closed-form "
            "divergences of a code given earlier ones need the model's order: keep it, or choose objective=trace_elbo"
        )
    for code, site in sampled.items():
        theirs = wanted[code]
        plates, given = ({frame.name for frame in each["cond_indep_stack"]} for each in (theirs, site))
        if missing := plates - given:
            raise UserError(
                f"{name} samples {code} outside of the plate {', '.join(sorted(missing))}: use windows_plate"
            )
        shape, wanted_shape = (f"{[*each['fn'].batch_shape]} {[*each['fn'].event_shape]}" for each in (site, theirs))
        if shape != wanted_shape:
            raise UserError(
                f"{name} samples {code} with batch and event shape {shape}, the model's is {wanted_shape}: "
                "the code's numbers are the event, see to_event(1)"
            )
        if ((site["log_prob"] != 0) & (theirs["log_prob"] == 0)).any():
            raise UserError(f"{name} does not mask {code} in windows that are masked: sample it within sequence_mask")


def _codes(program: nn.Module, window: Window) -> Sites:
    """Sampled sites by name, with their log densities, all of which are finite."""
    trace = poutine.trace(program).get_trace(window)
    trace.compute_log_prob()
    for name, site in sampled_sites(trace).items():
        if not site["log_prob"].isfinite().all():
            raise UserError(f"{type(program).__name__} gives {name} a density that is not finite: look at its options")
    return latent_sites(trace)


def _listed(sites: Iterable[str]) -> str:
    return ", ".join(sorted(sites)) or "none"
