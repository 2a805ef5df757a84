from __future__ import annotations

import pytest

from cavin_pyro.visualization.training import compare_runs


def rows(scale: float, *terms: str) -> list[dict[str, float]]:
    return [
        {"step": step, "training_loss": 0.0, **{f"validation_{term}": scale * step for term in terms}}
        for step in (1.0, 2.0, 3.0)
    ]


def test_every_term_has_a_panel_with_a_line_for_each_run_that_has_it() -> None:
    figure = compare_runs({"one": rows(1.0, "loss", "nll_actions"), "other": rows(2.0, "loss", "kl_motion_code")})
    panels = {panel.get_title(): panel.get_lines() for panel in figure.axes if panel.get_title()}
    assert {title: len(lines) for title, lines in panels.items()} == {"loss": 2, "nll actions": 1, "kl motion code": 1}
    assert [line.get_label() for line in panels["loss"]] == ["one", "other"]
    assert [list(line.get_ydata()) for line in panels["loss"]] == [[1, 2, 3], [2, 4, 6]]
    assert panels["kl motion code"][0].get_color() == panels["loss"][1].get_color()


def test_runs_without_a_validation_cannot_be_compared() -> None:
    for runs in ({}, {"one": rows(1.0, "loss"), "other": []}, {str(n): rows(1.0, "loss") for n in range(6)}):
        with pytest.raises(ValueError, match=r"^give 1 to 5 runs, each with a validation"):
            compare_runs(runs)
