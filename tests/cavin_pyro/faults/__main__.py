"""Faults by the thousand: `python -m tests.cavin_pyro.faults --count 2000 --log runs/faults.jsonl`; resumes.

A failure prints the line that repeats it, `--replay COMMAND FAULT [FAULT]`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from tqdm import tqdm

from cavin_pyro.storage.provenance import provenance
from tests.cavin_pyro.faults.commands import SUBJECTS, fast_folder
from tests.cavin_pyro.faults.plan import plans, singles
from tests.cavin_pyro.faults.report import table
from tests.cavin_pyro.faults.shim import Fault
from tests.cavin_pyro.faults.trials import REPLAY, Trials


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="faults in all, with those in the log")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end after so many, to go on later")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="+", choices=SUBJECTS, default=list(SUBJECTS))
    parser.add_argument("--log", type=Path, default=Path("runs/faults.jsonl"), help="a line of JSON for each trial")
    parser.add_argument("--replay", nargs="+", metavar=("COMMAND", "FAULT"), help="one trial, as a failure prints it")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=fast_folder()) as home:
        trials = Trials(Path(home))
        try:
            wrong = _replay(trials, *arguments.replay) if arguments.replay else _soak(trials, arguments)
        finally:
            trials.close()
    raise SystemExit(1 if wrong else 0)


def _replay(trials: Trials, name: str, *faults: str) -> int:
    outcome = trials.run(name, [Fault.parse(one) for one in faults])
    print("\n".join([f"{name}: {', '.join(outcome.ends) or 'the fault did not happen'}", *outcome.wrong]))
    return len(outcome.wrong)


def _soak(trials: Trials, arguments: argparse.Namespace) -> int:
    """Run what the log lacks and print the report; returns in how many trials something was wrong."""
    arguments.log.parent.mkdir(parents=True, exist_ok=True)
    lines = arguments.log.read_text().splitlines() if arguments.log.exists() else []
    rows = [json.loads(line) for line in lines if line.endswith("}")]
    done = {(row["command"], *row["faults"]) for row in rows}
    deadline = time.monotonic() + 60 * arguments.minutes
    for name in arguments.commands:
        trials.unbroken(name)
    calls = {name: trials.calls[name] for name in arguments.commands}
    print(f"{sum(map(len, calls.values()))} calls, {singles(calls)} faults one at a time; then two in a trial")
    happened, revision = sum(len(row["ends"]) for row in rows), provenance()["revision"]
    with (
        tqdm(desc="faults", total=arguments.count, initial=happened, unit=" faults") as bar,
        open(arguments.log, "a", encoding="utf-8") as log,
    ):
        for name, faults in plans(calls, arguments.seed):
            if happened >= arguments.count or time.monotonic() > deadline:
                break
            if (name, *map(str, faults)) in done:
                continue
            outcome = trials.run(name, faults)
            row = {"command": name, "faults": list(map(str, faults)), **vars(outcome), "revision": revision}
            rows.append(row)
            happened += len(outcome.ends)
            print(json.dumps(row), file=log, flush=True)
            bar.update(len(outcome.ends))
            if outcome.wrong:
                bar.write(f"{REPLAY} {name} {' '.join(row['faults'])}\n  " + "\n  ".join(outcome.wrong))
    revisions = ", ".join(dict.fromkeys(row["revision"][:7] for row in rows))
    print(f"\n{happened} faults in {len(rows)} trials at {revisions}\n\n{table(rows)}")
    return sum(bool(row["wrong"]) for row in rows)


if __name__ == "__main__":
    main()
