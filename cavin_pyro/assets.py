"""Fetch real meshes: `python -m cavin_pyro.assets ycb --to DIR`, then `env.objects=ycb env.assets=DIR`."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro.config.application import guarded
from cavin_pyro.config.errors import Parser


def main() -> None:
    """Download, decimate, decompose and verify one kind of assets; resumes an interrupted run."""
    guarded(_run, "assets")


def _run() -> None:
    from cavin_pyro.fetching.install import install
    from cavin_pyro.fetching.sawyer import SawyerRobot
    from cavin_pyro.fetching.ycb import YcbObjects

    kinds = {kind.name: kind for kind in (YcbObjects(), SawyerRobot())}
    parser = Parser(prog="python -m cavin_pyro.assets", description=main.__doc__)
    parser.add_argument("kind", choices=kinds, help="the ten YCB objects of the paper, or the Sawyer arm")
    to = "folder, in which the kind gets its own subfolder"
    parser.add_argument("--to", type=Path, required=True, metavar="DIR", help=to)
    parser.add_argument("--source", metavar="URL", help="a mirror of the publisher's site, with the same paths")
    arguments = parser.parse_args()
    print(install(kinds[arguments.kind], arguments.to, arguments.source))


if __name__ == "__main__":
    main()
