"""Exchange datasets: `python -m cavin_pyro.data export DIR --to DIR`, `... import minari:NAME --to DIR --env WORLD`."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro import __version__
from cavin_pyro.config.application import guarded
from cavin_pyro.config.errors import Parser


def main() -> None:
    """Export or import datasets."""
    guarded(_run, "data")


def _run() -> None:
    parser = Parser(prog="python -m cavin_pyro.data", description=main.__doc__)
    parser.add_argument("--version", action="version", version=f"cavin_pyro {__version__}")
    actions = parser.add_subparsers(dest="action", required=True, metavar="export|import")
    for name, what, said in (
        ("export", "DIR", "write a dataset from collect in Minari's format; needs the extra .[minari]"),
        ("import", "minari:NAME", "read a dataset in Minari's format, of states of a world; needs the extra .[minari]"),
    ):
        action = actions.add_parser(name, help=said, description=said)
        action.add_argument("dataset", metavar=what)
        where = "folder for the result; Minari wants a name such as NAME-v0"
        action.add_argument("--to", type=Path, required=True, metavar="DIR", help=where)
    world = "the world, and its options: --env pusht, or --env my.World size=3"
    action.add_argument("--env", nargs="+", required=True, metavar="WORLD", help=world)
    arguments = parser.parse_args()
    if arguments.action == "import":
        from cavin_pyro.data.importing import import_minari

        metadata = import_minari(arguments.dataset, arguments.to, arguments.env)
        print(f"{metadata['transitions']} transitions in {metadata['episodes']} episodes, in {arguments.to}")
    else:
        from cavin_pyro.data.export import export

        print(f"{export(Path(arguments.dataset), arguments.to)} episodes in {arguments.to}")


if __name__ == "__main__":
    main()
