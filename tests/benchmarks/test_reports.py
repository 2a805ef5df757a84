"""Reports of check stand beside one another as they are, and what is no report is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.benchmarks.loading import load

Report = dict[str, Any]


@pytest.fixture(scope="module")
def reports() -> Any:
    return load("reports")


def interval(mean: float) -> dict[str, float]:
    return {"mean": mean, "low": mean - 0.02, "high": mean + 0.03}


def error(mean: float) -> dict[str, float]:
    return {"mean": mean, "standard_error": 0.25}


def section(title: str, level: str, values: Report, *findings: str) -> Report:
    return {"title": title, "verdict": {"level": level}, "findings": findings, "values": values}


def cascade() -> Report:
    """A report on a model with c and z, short of what the tables leave out."""
    rises = {str(count): error(count / 10) for count in (1, 10, 1000)}
    scored = {"moved": {axis: {"coverage": {"90": share}} for axis, share in (("x", 0.8), ("y", 0.9))}}
    code = {
        "coverage": {"90": interval(0.9)},
        "coverage_informed": {"50": interval(0.55), "90": interval(0.91)},
        "informed": 3,
        "dimensions": 16,
        "kl": error(4.5),
        "active": 6,
        "simulated_information": {"low": interval(5.3), "high": interval(5.9)},
    }
    codes = {"effect_code": code, "motion_code": code}
    decoded = {group: interval(share) for group, share in (("guide", 0.86), ("prior", 0.6), ("shuffled", 0.2))}
    decoded |= {"observed": interval(0.92), "guide_minus": {"prior": interval(0.26)}}
    statistic = {name: {"mean": {"mean": mean}} for name, mean in (("guide_means", 0.1), ("prior_means", 0.05))}
    statistic["observed"] = {"mean": {"mean": 0.15}}
    ways = [("sampled", "sampled", 0.76), ("sampled", "closest", 0.39), ("chosen", "closest", 0.48)]
    ways += [("sampled", "closest in expectation", 0.3)]
    selections = [
        {
            **{"effect": effect, "motion": motion, "relative": left, "low": left - 0.05, "high": left + 0.05},
            **{
                "predicted_from_subgoal": 0.014,
                "from_subgoal": 0.049,
                "expected_from_subgoal": 0.03,
                "prediction": {"error": 0.03, "moved": 0.067},
            },
        }
        for effect, motion, left in ways
    ]
    difference = dict.fromkeys(("-ELBO", "h: subgoal centres", "f: next states"), error(5.4))
    near, far = {"distance": 0.003, "chance": 0.001}, {"distance": 0.001, "chance": 0.001}
    aggregate = {name: {"windows": 1000, "all_dimensions": far, "active_dimensions": near} for name in codes}
    told = {"prior": {"auc": interval(0.78)}, "shuffled": {"auc": interval(0.93)}}
    scales = dict.fromkeys(("f_centers", "f_features", "h_centers", "h_features", "g_start", "g_motion"))
    words = "all codes: at least 19 nats short; k-hat is above 0.67 for 34% of the windows (28% to 41%)."
    guide_error = {"joint": {"rises": rises, "pareto_k": {"above_limit": 0.34}}, "motion_code": {"rises": rises}}
    sections = {
        "elbo": section("The ELBO", "inspect", {"difference": difference}),
        "guide_error": section(
            "The guide", "inspect", {**guide_error, "effect_code_given_subgoal": {"rises": rises}}, words
        ),
        "amortization": section(
            "The gap", "bad", {"gap": error(17.25), "gap_median": 5.379, "approximation_gap": error(0.7)}
        ),
        "simulation": section("Simulation", "good", {"program": {"codes": codes, "joint": {"90": interval(0.88)}}}),
        "codes": section("Codes", "good", codes),
        "prior": section(
            "The prior",
            "bad",
            {
                "classifier": told,
                "coverage": {name: {"prior": interval(0.05)} for name in ("codes", "first push")},
                "decoded": dict.fromkeys(("first_push_near", "farthest_move", "overlap"), decoded),
            },
        ),
        "aggregate_posterior": section("Heaps", "good", {**aggregate, "together": far}),
        "predictive": section(
            "Predictive",
            "bad",
            {
                "statistics": dict.fromkeys(
                    ("farthest_move_h", "farthest_move_f", "touching", "close_pairs_h"), statistic
                ),
                "effects": dict.fromkeys(("farthest_move_f", "touching"), interval(-2.3)),
            },
        ),
        "calibration": section(
            "Scales",
            "bad",
            {"scales": {name: {"ratio": interval(1.4)} for name in scales}, "scores": {"f": scored, "h_guide": scored}},
        ),
        "growth": section(
            "Growth",
            "inspect",
            {
                "errors": {name: [{"mean": 0.025}, {"mean": 0.08}, {"mean": 0.127}] for name in "fh"},
                "relative": interval(0.6),
            },
        ),
        "consistency": section("Consistency", "inspect", {"selections": selections}),
    }
    about = {"windows": {"training": 2000, "validation": 1624}, "episodes": {"training": 1556, "validation": 437}}
    return {"about": about, "sections": sections}


def without_codes() -> Report:
    """The same of a model that has f alone."""
    found = cascade()
    for name in ("guide_error", "amortization", "simulation", "codes", "prior", "aggregate_posterior", "consistency"):
        found["sections"][name] |= {"verdict": {"level": "none"}, "values": {}}
    predictive = found["sections"]["predictive"]["values"]["statistics"]
    found["sections"]["predictive"]["values"]["statistics"] = {
        "farthest_move_f": {name: predictive["farthest_move_f"][name] for name in ("prior_means", "observed")}
    }
    return found


def written(folder: Path, report: Report) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "report.json").write_text(json.dumps(report))
    return str(folder)


def tables(
    reports: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *folders: str
) -> dict[str, list[str]]:
    """The cells of both tables by the label of their row."""
    monkeypatch.setattr("sys.argv", ["reports.py", *folders])
    reports.main()
    lines = [line.strip("|").split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    return {label.strip(): [one.strip() for one in cells] for label, *cells in lines}


@pytest.fixture
def shown(
    reports: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> dict[str, list[str]]:
    folders = written(tmp_path / "cavin", cascade()), written(tmp_path / "mpc", without_codes())
    return tables(reports, capsys, monkeypatch, *folders)


def test_a_model_with_both_codes_has_every_figure(shown: dict[str, list[str]]) -> None:
    assert shown["section"] == shown["figure"] == ["`cavin`", "`mpc`"]
    assert [label for label, cells in shown.items() if cells[0] == "-"] == []
    expected = {
        "Simulation": "good",
        "The gap": "bad",
        "held-out windows of episodes": "1,624 of 437",
        "-ELBO, held-out less training windows, nats": "5.40 ± 0.25",
        "nats from guide to posterior, at least": "100.00 ± 0.25",  # of the most samples, not the first key
        "windows whose k-hat is above its limit": "34 % (28 to 41)",
        "coverage of 90 % intervals of c, informed dimensions": "91.0 % (89.0 to 94.0), 3 of 16",
        "first push passes near an object, % (1)": "86.0, 60.0, 20.0, 92.0",
        "codes without their states: distance beyond chance": "0.0020",
        "farthest move by f along the pushes, cm (2)": "10.0, 5.0, 15.0",
        "coverage of 90 % intervals of f, centres that moved": "85 %",
        "f is off after 1 and 10 segments, cm": "2.5, 12.7",
        "remaining distance: sampled effect, closest motion": "39 % (34 to 44)",
        "f expects to be left; is left, cm": "1.4, 4.9",
        "remaining distance: sampled effect, motion closest in expectation": "30 % (25 to 35)",
        "f's distribution expects to be left; is left, cm": "3.0, 4.9",
    }
    assert {label: shown[label][0] for label in expected} == expected


def test_what_does_not_apply_to_a_model_is_a_dash(shown: dict[str, list[str]]) -> None:
    assert {label: shown[label][1] for label in ("The ELBO", "The prior", "Consistency")} == {
        "The ELBO": "inspect",
        "The prior": "-",
        "Consistency": "-",
    }
    for label in ("AUC: a guide's codes against a prior's", "remaining distance: sampled effect and motion"):
        assert shown[label][1] == "-"
    assert shown["farthest move by f along the pushes, cm (2)"][1] == "-, 5.0, 15.0"


def test_another_report_changes_the_verdict_and_the_figure_that_it_changes_and_no_other(
    reports: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = cascade()
    other["sections"]["prior"]["verdict"]["level"] = "good"
    other["sections"]["prior"]["values"]["classifier"]["prior"]["auc"] = interval(0.55)
    other["sections"]["calibration"]["values"]["scales"]["g_start"]["ratio"]["mean"] = None  # not finite
    folders = written(tmp_path / "one", cascade()), written(tmp_path / "other", other)
    found = tables(reports, capsys, monkeypatch, *folders)
    changed = {label: cells for label, cells in found.items() if cells[0] != cells[1] and not label.startswith("fig")}
    assert changed == {
        "section": ["`one`", "`other`"],
        "The prior": ["bad", "good"],
        "AUC: a guide's codes against a prior's": ["78 % (76 to 81)", "55 % (53 to 58)"],
        "stated scale over RMS error: starts of pushes of g": ["1.40 (1.38 to 1.43)", "-"],
    }


def test_a_report_with_an_old_level_is_shown_with_the_new_one(
    reports: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    old = cascade()
    for section in old["sections"].values():
        if section["verdict"]["level"] == "inspect":
            section["verdict"]["level"] = "look"
    folders = written(tmp_path / "old", old), written(tmp_path / "new", cascade())
    found = tables(reports, capsys, monkeypatch, *folders)
    assert found["The ELBO"] == ["inspect", "inspect"]
    assert all(len(set(cells)) == 1 for label, cells in found.items() if not label.startswith(("section", "fig")))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read: No such file or directory"),
        ("{", "is damaged: it is not JSON"),
        ('{"about": {}, "sections": []}', "is no report: give folders of check"),
    ],
)
def test_a_folder_without_a_readable_report_is_refused_in_a_line(
    content: str | None,
    said: str,
    reports: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    good = written(tmp_path / "good", cascade())
    if content is not None:
        (tmp_path / "report.json").write_text(content)
    with pytest.raises(SystemExit) as ended:
        tables(reports, capsys, monkeypatch, good, str(tmp_path))
    printed = capsys.readouterr()
    assert ended.value.code == 2 and printed.out == ""
    assert printed.err.startswith(f"{tmp_path / 'report.json'} {said}") and printed.err.count("\n") == 1


def test_two_folders_of_one_name_are_refused(
    reports: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "old").mkdir()
    folders = written(tmp_path / "cavin", cascade()), written(tmp_path / "old" / "cavin", cascade())
    with pytest.raises(SystemExit) as ended:
        tables(reports, capsys, monkeypatch, *folders)
    assert ended.value.code == 2 and capsys.readouterr().err.startswith("two folders are called cavin: ")
