from __future__ import annotations

from cavin_pyro.launching.order import Order

ARRIVALS = [2, 0, 3, 1, 4]


def test_ordered_results_wait_for_those_before_them() -> None:
    order = Order[str](ordered=True)
    found = [[number for number, _ in order.add(one, f"result {one}")] for one in ARRIVALS]
    assert found == [[], [0], [], [1, 2, 3], [4]] and order.yielded == 5


def test_others_come_at_once_each_alone() -> None:
    order = Order[str](ordered=False)
    found = [list(order.add(one, f"result {one}")) for one in ARRIVALS]
    assert found == [[(one, f"result {one}")] for one in ARRIVALS] and order.yielded == 5
