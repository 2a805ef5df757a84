"""Compare methods on the same scenes: `python -m cavin_pyro.compare RUN RUN ...`."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro import __version__
from cavin_pyro.config.application import guarded
from cavin_pyro.config.errors import Parser


def main() -> None:
    """Compare folders of evaluate, or tables of episodes, with the first: success, intervals and paired tests."""
    guarded(_run, "compare")


def _run() -> None:
    parser = Parser(prog="python -m cavin_pyro.compare", description=main.__doc__)
    parser.add_argument("--version", action="version", version=f"cavin_pyro {__version__}")
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="folder, FILE.csv or FILE.parquet: a method")
    several = "a method with a run for each training; may be given several times"
    parser.add_argument("--method", nargs="+", action="append", default=[], metavar=("NAME", "RUN"), help=several)
    parser.add_argument("--output", type=Path, default=Path("compare.html"), metavar="FILE", help="the page")
    line = parser.parse_args()
    named = {name: runs for name, *runs in line.method}
    if (not line.runs and not named) or len(named) < len(line.method) or "" in named:
        parser.error("give at least one RUN, and each --method NAME RUN once, with a name")
    if line.output.suffix != ".html" or not line.output.parent.is_dir():
        parser.error(f"--output {line.output} must be FILE.html, in a folder that is there")
    from cavin_pyro.evaluation.comparison import as_text, compare, write_page

    table = compare(*line.runs, **named)
    write_page(line.output, table)
    print(f"{as_text(table)}\n{line.output}")


if __name__ == "__main__":
    main()
