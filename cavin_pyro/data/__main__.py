"""Look after datasets: `python -m cavin_pyro.data verify|export DIR`."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro import __version__
from cavin_pyro.config.application import guarded
from cavin_pyro.config.errors import Parser


def main() -> None:
    """Verify or export datasets from collect."""
    guarded(_run, "data")


def _run() -> None:
    arguments = _parser().parse_args()
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
    actions = parser.add_subparsers(dest="action", required=True, metavar="verify|export")
    for name, how_many, said in (
        ("verify", "+", "read every file and name each defect in a line; exit status 2 if there is one"),
        ("export", 1, "write a dataset in Minari's format; needs the extra .[minari]"),
    ):
        action = actions.add_parser(name, help=said, description=said)
        action.add_argument("folders", nargs=how_many, metavar="DIR", help="dataset folder from collect")
        if name == "export":
            where = "folder for the result; Minari wants a name such as NAME-v0"
            action.add_argument("--to", type=Path, required=True, metavar="DIR", help=where)
    return parser


if __name__ == "__main__":
    main()
