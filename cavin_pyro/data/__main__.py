"""Look after datasets: `python -m cavin_pyro.data verify|export DIR`, `... import minari:NAME`."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro import __version__
from cavin_pyro.config.application import guarded
from cavin_pyro.config.errors import Parser


def main() -> None:
    """Verify, export or import datasets."""
    guarded(_run, "data")


def _run() -> None:
    arguments = _parser().parse_args()
    if arguments.action == "import":
        from cavin_pyro.data.importing import import_minari

        metadata = import_minari(arguments.folders[0], arguments.to, arguments.env)
        print(f"{metadata['transitions']} transitions in {metadata['episodes']} episodes, in {arguments.to}")
        return
    folders = [Path(folder) for folder in arguments.folders]
    if arguments.action == "export":
        from cavin_pyro.data.export import export

        print(f"{export(folders[0], arguments.to)} episodes in {arguments.to}")
        return
    from cavin_pyro.data.maintenance import verify

    for folder in folders:
        verify(folder)


def _parser() -> Parser:
    parser = Parser(prog="python -m cavin_pyro.data", description=main.__doc__)
    parser.add_argument("--version", action="version", version=f"cavin_pyro {__version__}")
    actions = parser.add_subparsers(dest="action", required=True, metavar="verify|export|import")
    for name, how_many, said in (
        ("verify", "+", "read every file and name each defect in a line; exit status 2 if there is one"),
        ("export", 1, "write a dataset in Minari's format; needs the extra .[minari]"),
        ("import", 1, "read a dataset in Minari's format, of states of a world; needs the extra .[minari]"),
    ):
        action = actions.add_parser(name, help=said, description=said)
        what = ("minari:NAME", "dataset of Minari") if name == "import" else ("DIR", "dataset folder from collect")
        action.add_argument("folders", nargs=how_many, metavar=what[0], help=what[1])
        if name != "verify":
            where = "folder for the result; Minari wants a name such as NAME-v0"
            action.add_argument("--to", type=Path, required=True, metavar="DIR", help=where)
        if name == "import":
            world = "the world, and its options: --env pusht, or --env my.World size=3"
            action.add_argument("--env", nargs="+", required=True, metavar="WORLD", help=world)
    return parser


if __name__ == "__main__":
    main()
