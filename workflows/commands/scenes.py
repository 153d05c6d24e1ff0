"""`stickslip scenes`, `init` and `schema`: what can be run, and how to begin a scene of one's own."""

from __future__ import annotations

import argparse
from pathlib import Path

from stickslip.workflows.commands.command import DONE, Command, Wrong


class Scenes(Command):
    """List the scenes that ship, with members and time."""

    examples = (("stickslip scenes", ""),)

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.workflows.scaffold import listing

        print("\n".join(listing()))
        return DONE


class Init(Command):
    """Write a commented scene to start from."""

    examples = (("stickslip init", "writes scene.toml"), ("stickslip init mine.toml", ""))

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("file", type=Path, nargs="?", default=Path("scene.toml"), metavar="FILE")

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.workflows.scaffold import NotWritten, new_scene

        try:
            print("\n".join(new_scene(arguments.file)))
        except NotWritten as error:
            raise Wrong(error) from None
        return DONE


class Schema(Command):
    """Print the JSON Schema of scene files, with which editors complete and check them."""

    examples = (
        ("stickslip schema > stickslip.schema.json", "for ensembles, as `stickslip init` writes it"),
        ("stickslip schema stability", "for the scenes of a chart"),
        ("stickslip schema --keys", "every key: default, meaning, values"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "chart", nargs="?", metavar="CHART", help="a kind of chart, the key `chart` of its scenes"
        )
        parser.add_argument("--keys", action="store_true", help="list the keys in words instead, one a line")

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.workflows.scaffold import key_lines, schema_text

        if arguments.chart is not None:
            from stickslip.workflows.gallery import CHARTS

            if arguments.chart not in CHARTS:
                raise Wrong(
                    f"CHART: expected one of {', '.join(CHARTS)}, got {arguments.chart!r}; leave it out for ensembles"
                )
        print("\n".join(key_lines(arguments.chart)) if arguments.keys else schema_text(arguments.chart).rstrip())
        return DONE
