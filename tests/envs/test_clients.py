"""Simulations in threads, and copies of them."""

from __future__ import annotations

import copy
import os
import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest

from envs.physics import bullet
from envs.pushing import PushingEnv


def test_connecting_in_threads_leaves_the_output_where_it_was() -> None:
    """Two threads that redirect the output at once would restore the null device."""
    before = os.fstat(1)

    def redirect(_: int) -> None:
        with bullet._quiet(1):
            os.sched_yield()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(redirect, range(400)))
    after = os.fstat(1)
    assert (after.st_dev, after.st_ino) == (before.st_dev, before.st_ino)


def test_an_environment_is_neither_copied_nor_pickled() -> None:
    env = PushingEnv(task="clearing", objects=1)
    try:
        for act in (copy.deepcopy, pickle.dumps):
            with pytest.raises(
                TypeError, match="a simulation cannot be copied: make a second environment and reset it"
            ):
                act(env)
    finally:
        env.close()
