"""Reports of `check` beside one another: `python benchmarks/reports.py FOLDER ...`.

Two Markdown tables with a column per folder, named like it: the verdict of each section, and the figures that decide
it, with 95 % intervals in brackets or a standard error after ±. A dash stands where a section does not apply to a model
(MPC has no codes, models without h have no subgoals) and where a report lacks it.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.verdicts.verdict import RENAMED
from cavin_pyro.storage.files import read_json

Values = Mapping[str, Any]
NOTHING = "-"


def error(value: Values) -> str:
    """A mean with its standard error."""
    return f"{value['mean']:.2f} ± {value['standard_error']:.2f}"


def interval(value: Values, *, times: int = 1, digits: int = 2, unit: str = "", mean: str = "mean") -> str:
    """`times` is 100 for shares."""
    middle, low, high = (f"{times * value[end]:.{digits}f}" for end in (mean, "low", "high"))
    return f"{middle}{unit} ({low} to {high})"


def bounds(value: Values) -> str:
    return f"{value['low']['mean']:.2f} to {value['high']['mean']:.2f}"


def median(value: float) -> str:
    return f"{value:.2f}"


def hundredfold(values: Iterable[float | None]) -> str:
    """Shares as percentages, or metres as centimetres."""
    return ", ".join(NOTHING if value is None else f"{100 * value:.1f}" for value in values)


def windows(about: Values) -> str:
    return f"{about['windows']['validation']:,} of {about['episodes']['validation']:,}"


def shortfall(rises: Values) -> str:
    """By the bound of the most samples."""
    return error(rises[max(rises, key=int)])


def tails(section: Values) -> str:
    """The share of windows above k-hat's limit, whose interval is in the report's words alone."""
    share = section["values"]["joint"]["pareto_k"]["above_limit"]
    ends = re.search(r"% of the windows \((\d+)% to (\d+)%\)", section["findings"][0])
    return f"{100 * share:.0f} %{f' ({ends[1]} to {ends[2]})' if ends else ''}"


def cost(code: Values) -> str:
    return f"{error(code['kl'])}, {code['active']} of {code['dimensions']}"


def informed(code: Values) -> str:
    return f"{tenths(code['coverage_informed']['90'])}, {code['informed']} of {code['dimensions']}"


def groups(decoded: Values) -> str:
    return hundredfold(decoded[group]["mean"] for group in ("guide", "prior", "shuffled", "observed"))


def beyond_chance(section: Values) -> str:
    """The largest energy distance less what chance gives, by which the section's verdict goes."""
    parts = [value for value in section["values"].values() if value]
    tests = [*parts, *(test for part in parts for test in part.values() if isinstance(test, dict))]
    return f"{max(test['distance'] - test['chance'] for test in tests if 'chance' in test):.4f}"


def replicates(statistic: Values) -> str:
    """Codes of the guide, of the prior as planned, observed; MPC has the pushes that were made and no codes."""
    sources = (statistic.get(name) for name in ("guide_means", "prior_means", "observed"))
    return hundredfold(None if source is None else source["mean"]["mean"] for source in sources)


def covered(moved: Values) -> str:
    return f"{50 * sum(moved[axis]['coverage']['90'] for axis in 'xy'):.0f} %"


def ends(errors: Sequence[Values]) -> str:
    return hundredfold(errors[place]["mean"] for place in (0, -1))


def rollout(selections: Sequence[Values], effect: str, motion: str) -> Values:
    """The one motion of a model with one code counts as sampled."""
    names = {motion, "given"} if motion == "sampled" else {motion}
    return next(one for one in selections if one["effect"] == effect and one["motion"] in names)


def remaining(effect: str, motion: str) -> Callable[[Sequence[Values]], str]:
    return lambda selections: whole(rollout(selections, effect, motion), mean="relative")


def promised(motion: str, by: str) -> Callable[[Sequence[Values]], str]:
    """What f says will be left, and what is left."""

    def written(selections: Sequence[Values]) -> str:
        one = rollout(selections, "sampled", motion)
        return hundredfold((one[by], one["from_subgoal"]))

    return written


def missed(selections: Sequence[Values]) -> str:
    prediction = rollout(selections, "sampled", "sampled")["prediction"]
    return hundredfold((prediction["error"], prediction["moved"]))


whole, tenths = (partial(interval, times=100, digits=digits, unit=" %") for digits in (0, 1))
points, point = (partial(interval, times=100, digits=digits) for digits in (0, 1))
C, Z = "effect_code", "motion_code"

# What a row says, where it stands in a report ("section" or "section/values ..."), and how it is written.
FIGURES: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
    ("held-out windows of episodes", "about", windows),
    ("-ELBO, held-out less training windows, nats", "elbo/difference/-ELBO", error),
    ("of these h's subgoal centres", "elbo/difference/h: subgoal centres", error),
    ("of these f's next states", "elbo/difference/f: next states", error),
    ("nats from guide to posterior, at least", "guide_error/joint/rises", shortfall),
    ("recovered by 10 importance samples, nats", "guide_error/joint/rises/10", error),
    ("nats from guide to posterior: c for p(c given s, s')", f"guide_error/{C}_given_subgoal/rises", shortfall),
    ("nats from guide to posterior: z for p(z given s, a, c)", f"guide_error/{Z}/rises", shortfall),
    ("windows whose k-hat is above its limit", "guide_error", tails),
    ("nats that refining the guide for each window gains", "amortization/gap", error),
    ("the same, median over windows", "amortization/gap_median", median),
    ("nats left to the guide's family, at least", "amortization/approximation_gap", error),
    ("coverage of 90 % intervals of c, all dimensions", f"simulation/program/codes/{C}/coverage/90", tenths),
    ("coverage of 90 % intervals of c, informed dimensions", f"simulation/program/codes/{C}", informed),
    (
        "coverage of 50 % intervals of c, informed dimensions",
        f"simulation/program/codes/{C}/coverage_informed/50",
        tenths,
    ),
    ("coverage of 90 % intervals of z, all dimensions", f"simulation/program/codes/{Z}/coverage/90", tenths),
    ("coverage of 90 % intervals of z, informed dimensions", f"simulation/program/codes/{Z}", informed),
    ("coverage of the 90 % region of all codes", "simulation/program/joint/90", tenths),
    ("E KL(q, p) of c, nats, and active dimensions", f"codes/{C}", cost),
    ("E KL(q, p) of z, nats, and active dimensions", f"codes/{Z}", cost),
    ("nats that c carries in generated windows", f"codes/{C}/simulated_information", bounds),
    ("nats that z carries in generated windows", f"codes/{Z}/simulated_information", bounds),
    ("AUC: a guide's codes against a prior's", "prior/classifier/prior/auc", whole),
    ("AUC: a guide's codes against another scene's", "prior/classifier/shuffled/auc", whole),
    ("expected coverage of codes is off by, points", "prior/coverage/codes/prior", points),
    ("expected coverage of first pushes' starts is off by, points", "prior/coverage/first push/prior", points),
    ("first push passes near an object, % (1)", "prior/decoded/first_push_near", groups),
    ("first push near an object: guide less prior, points", "prior/decoded/first_push_near/guide_minus/prior", point),
    ("farthest move in the subgoal, cm (1)", "prior/decoded/farthest_move", groups),
    ("subgoals in which two objects overlap, % (1)", "prior/decoded/overlap", groups),
    ("codes without their states: distance beyond chance", "aggregate_posterior", beyond_chance),
    ("farthest move by h, cm (2)", "predictive/statistics/farthest_move_h", replicates),
    ("farthest move by f along the pushes, cm (2)", "predictive/statistics/farthest_move_f", replicates),
    ("farthest move by f, prior less observed, deviations", "predictive/effects/farthest_move_f", interval),
    ("pushes that pass near a centre, % (2)", "predictive/statistics/touching", replicates),
    ("pushes near a centre, prior less observed, deviations", "predictive/effects/touching", interval),
    ("subgoals with centres too close, % (2)", "predictive/statistics/close_pairs_h", replicates),
    ("stated scale over RMS error: centres of f", "calibration/scales/f_centers/ratio", interval),
    ("stated scale over RMS error: features of f", "calibration/scales/f_features/ratio", interval),
    ("stated scale over RMS error: centres of h", "calibration/scales/h_centers/ratio", interval),
    ("stated scale over RMS error: features of h", "calibration/scales/h_features/ratio", interval),
    ("stated scale over RMS error: starts of pushes of g", "calibration/scales/g_start/ratio", interval),
    ("stated scale over RMS error: motions of pushes of g", "calibration/scales/g_motion/ratio", interval),
    ("coverage of 90 % intervals of f, centres that moved", "calibration/scores/f/moved", covered),
    ("coverage of 90 % intervals of h, centres that moved, guide's codes", "calibration/scores/h_guide/moved", covered),
    ("f is off after 1 and 10 segments, cm", "growth/errors/f", ends),
    ("h is off after 1 and 10 segments, cm", "growth/errors/h", ends),
    ("f after 10 segments, of the error if nothing moves", "growth/relative", whole),
    ("f is off along the prior's pushes; objects move, cm", "consistency/selections", missed),
    (
        "remaining distance: sampled effect and motion",
        "consistency/selections",
        remaining("sampled", "sampled"),
    ),
    (
        "remaining distance: sampled effect, closest motion",
        "consistency/selections",
        remaining("sampled", "closest"),
    ),
    ("f expects to be left; is left, cm", "consistency/selections", promised("closest", "predicted_from_subgoal")),
    (
        "remaining distance: sampled effect, motion closest in expectation",
        "consistency/selections",
        remaining("sampled", "closest in expectation"),
    ),
    (
        "f's distribution expects to be left; is left, cm",
        "consistency/selections",
        promised("closest in expectation", "expected_from_subgoal"),
    ),
    (
        "remaining distance: chosen effect, closest motion",
        "consistency/selections",
        remaining("chosen", "closest"),
    ),
)


def read(folder: Path) -> Values:
    """The report in a folder.

    Raises:
        UserError: there is none that can be read.
    """
    report = read_json(folder / "report.json")
    if not isinstance(report, dict) or not isinstance(report.get("sections"), dict) or "about" not in report:
        raise UserError(f"{folder / 'report.json'} is no report: give folders of check")
    return report


def read_all(folders: Sequence[Path]) -> dict[str, Values]:
    """Reports by the names of their folders.

    Raises:
        UserError: one cannot be read, or two have one name.
    """
    names = [folder.resolve().name for folder in folders]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise UserError(f"two folders are called {twice[0]}: columns are named like folders, so rename one")
    return {name: read(folder) for name, folder in zip(names, folders, strict=True)}


def cell(report: Values, place: str, written: Callable[[Any], str]) -> str:
    section, *inside = place.split("/")
    try:
        value = {"about": report["about"], **report["sections"]}[section]
        for key in ("values", *inside) if inside else ():
            value = value[key]
        return written(value)
    except (KeyError, StopIteration, TypeError, ValueError):  # not run, no such part of the model, or null
        return NOTHING


def verdict(section: Values) -> str:
    level: str = section["verdict"]["level"]
    return NOTHING if level == "none" else RENAMED.get(level, level)


def table(head: str, reports: Mapping[str, Values], rows: Iterable[tuple[str, str, Callable[[Any], str]]]) -> str:
    """In Markdown."""
    lines = [[head, *(f"`{name}`" for name in reports)], ["---"] * (len(reports) + 1)]
    lines += [[label, *(cell(report, place, written) for report in reports.values())] for label, place, written in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", help="of python -m cavin_pyro.check")
    try:
        reports = read_all(parser.parse_args().folders)
    except UserError as problem:
        parser.exit(2, f"{problem}\n")
    titles = {name: section["title"] for one in reports.values() for name, section in one["sections"].items()}
    print(table("section", reports, ((title, name, verdict) for name, title in titles.items())))
    print()
    print(table("figure", reports, FIGURES))
    print()
    print("(1) Codes of the guide, of the prior, of the prior in another scene; observed.")
    print("(2) Codes of the guide, of the prior as planned; observed. MPC has no codes: the pushes that were made.")


if __name__ == "__main__":
    main()
