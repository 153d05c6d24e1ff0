"""`stickslip extend`: a dataset with more records than another, whose runs it takes over."""

from __future__ import annotations

import argparse
import tomllib
from typing import Any

from stickslip.pipeline.errors import printable
from stickslip.workflows.commands.command import Command, Wrong, add_places
from stickslip.workflows.commands.run import add_options, check_directory, check_name, run, say_estimate


class Extend(Command):
    """Add records to a dataset, in another directory, running no more than it must."""

    examples = (
        ("stickslip extend runs/mine --record waiting --out runs/more", "from the events that are kept"),
        ("stickslip extend runs/mine --record waiting t_burn=50 --out runs/more", "measured from t = 50"),
        ("stickslip extend runs/mine --record amplitude dt=0.1 --out runs/more --dry-run", "what reruns would take"),
        ("stickslip extend runs/mine --record mine:quiet --out runs/more", "by your own function, in mine.py"),
        ("stickslip extend runs/mine --scene mine.toml --out runs/more", "a scene with more records or members"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        # argparse names DIR last, where it would be taken for one more key
        parser.usage = "%(prog)s DIR (--record KEY[=VALUE] ... | --scene FILE) --out DIR2 [options]"
        parser.add_argument("directory", metavar="DIR")
        what = parser.add_mutually_exclusive_group(required=True)
        what.add_argument(
            "--record",
            nargs="+",
            metavar="KEY[=VALUE]",
            help="keys under [record] of a scene; one without a value is true; or module:function, for its `own`",
        )
        what.add_argument("--scene", metavar="FILE", help="a scene file whose members are those of DIR, or more")
        parser.add_argument(
            "--out", required=True, metavar="DIR2", help="directory of the new dataset, or its address"
        )
        add_places(parser)
        add_options(parser)

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.pipeline.dataset.opened import open_dataset
        from stickslip.pipeline.places.locate import place_of
        from stickslip.pipeline.running.extend import with_records
        from stickslip.workflows.scenes import find, load

        check_name("--out", arguments.out)
        keys = _keys(arguments.record or [])
        if arguments.dry_run and arguments.scheduler is not None:
            raise Wrong("--scheduler: expected none with --dry-run, which uses this machine; leave it out")
        opened, out = open_dataset(arguments.directory), place_of(arguments.out)
        if arguments.scene is None:
            file, scene, asked = (
                opened.folder / "scene.toml",
                with_records(opened, keys),
                ["--record", *arguments.record],
            )
        else:
            file, asked = find(arguments.scene), ["--scene", arguments.scene]
            scene = load(file)
        check_directory(out, file)
        if opened.n_done < opened.n_members:
            where = printable(str(opened.place))
            print(f"from    {where}: {opened.n_done} of {opened.n_members} members; the others are run", flush=True)
        if arguments.dry_run:
            return say_estimate(arguments, scene, file, out, opened)
        words = ("extend", arguments.directory, *asked, "--out", str(out))
        return run(arguments, words, lambda: scene, file, out, opened)


def _keys(given: list[str]) -> dict[str, Any]:
    """Keys under [record], with their values."""
    keys: dict[str, Any] = {}
    for text in given:
        key, is_valued, value = text.partition("=")
        if not is_valued and ":" in key:
            keys.setdefault("own", []).append(key)
            continue
        if key in keys:
            raise Wrong(f"--record: expected each key once, got {key} twice; leave one out")
        try:
            keys[key] = tomllib.loads(f"value = {value}")["value"] if is_valued else True
        except tomllib.TOMLDecodeError:
            raise Wrong(f"--record: expected a value as a scene has it, such as t_burn=50, got {text!r}") from None
    return keys
