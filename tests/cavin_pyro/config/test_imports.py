from __future__ import annotations

import gc

import pytest

from cavin_pyro.config.imports import without_collections


@pytest.mark.parametrize("collecting", [True, False])
def test_nothing_is_collected_within_and_what_is_made_there_is_not_looked_through_later(collecting: bool) -> None:
    before = gc.isenabled()
    (gc.enable if collecting else gc.disable)()
    try:
        with pytest.raises(ImportError), without_collections():
            assert not gc.isenabled()
            made: list[list[int]] = [[number] for number in range(1000)]
            raise ImportError
        assert gc.isenabled() is collecting
    finally:
        (gc.enable if before else gc.disable)()
    looked_through = {id(one) for one in gc.get_objects()}
    assert not any(id(one) in looked_through for one in made)
