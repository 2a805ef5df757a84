from __future__ import annotations

import pyro
from pyro import poutine
from pyro.infer import SVI, Trace_ELBO
from torch import Tensor, nn

from models.program import Program


class Coin(Program):
    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Linear(1, 1)

    def forward(self, data: Tensor) -> None:
        with pyro.plate("data", len(data)):
            mean = self.network(data.unsqueeze(-1)).squeeze(-1)
            pyro.sample("x", pyro.distributions.Normal(mean, 1.0), obs=data)


class Nothing(Program):
    def forward(self, data: Tensor) -> None:
        pass


def registered(local: bool) -> list[str]:
    with pyro.settings.context(module_local_params=local):
        return poutine.trace(Coin()).get_trace(Tensor([1.0, 2.0])).param_nodes


def test_parameters_are_registered_unless_they_are_module_local() -> None:
    assert registered(local=False) == ["Coin$$$network.weight", "Coin$$$network.bias"]
    assert registered(local=True) == []


def test_svi_with_the_global_store_trains_the_networks() -> None:
    with pyro.settings.context(module_local_params=False):
        model = Coin()
        before = model.network.weight.detach().clone()
        svi = SVI(model, Nothing(), pyro.optim.Adam({"lr": 0.1}), Trace_ELBO())
        losses = [svi.step(Tensor([1.0, 2.0])) for _ in range(20)]
    assert losses[-1] < losses[0]
    assert (model.network.weight != before).all()
