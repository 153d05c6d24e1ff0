"""`stickslip extend`: more records for a dataset that is finished."""

from __future__ import annotations

import argparse
import sys
import tomllib
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from stickslip.pipeline.errors import command, printable
from stickslip.pipeline.machine.processes import forked_workers, loading
from stickslip.pipeline.machine.signals import Interrupted
from stickslip.workflows.commands.command import DONE, Command, Wrong, add_places

if TYPE_CHECKING:
    from stickslip.pipeline.running.extend import Addition


class Extend(Command):
    """`stickslip extend`."""

    name = "extend"
    words = "add records to a finished dataset, running no more than it must"
    examples = (
        ("stickslip extend runs/mine --record waiting", "from the events that the dataset keeps"),
        ("stickslip extend runs/mine --record waiting stick_share t_burn=50", "measured from t = 50"),
        ("stickslip extend runs/mine --record amplitude dt=0.1 --dry-run", "what members that run again would take"),
        ("stickslip extend runs/mine --record mine:quiet_share t_burn=50", "by a function of your own, in mine.py"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        # argparse names DIR last, where it would be taken for one more key
        parser.usage = "%(prog)s DIR (--record KEY[=VALUE] ... | --give-up) [options]"
        parser.add_argument("directory", metavar="DIR")
        what = parser.add_mutually_exclusive_group(required=True)
        what.add_argument(
            "--record", nargs="+", metavar="KEY[=VALUE]",
            help="keys under [record] of a scene; one without a value is true; or module:function, for its `own`",
        )  # fmt: skip
        what.add_argument(
            "--give-up", action="store_true", help="forget an extension that was begun; the dataset stays as it is"
        )
        add_places(parser)
        parser.add_argument("--accept-version", action="store_true", help="extend data that another version wrote")
        parser.add_argument(
            "--dry-run", action="store_true", help="show what would be run and estimate the time; write nothing"
        )

    def __call__(self, arguments: argparse.Namespace) -> int:
        if arguments.give_up:
            return _give_up(arguments.directory)
        keys = _keys(arguments.record)
        if arguments.dry_run and arguments.scheduler is not None:
            raise Wrong("--scheduler: expected none with --dry-run, which uses this machine; leave it out")
        are_forked = arguments.is_program and arguments.workers > 0 and arguments.scheduler is None
        with forked_workers() if are_forked and not arguments.dry_run else nullcontext():
            return _extend(arguments, keys)


def _extend(arguments: argparse.Namespace, keys: dict[str, Any]) -> int:
    with loading() if arguments.is_program else nullcontext():
        from stickslip.pipeline.dataset.opened import open_dataset
        from stickslip.pipeline.machine.signals import last_act
        from stickslip.pipeline.places.place import DATA, SCENE
        from stickslip.pipeline.running.extend import addition, extend, is_there
        from stickslip.workflows import own_questions
        from stickslip.workflows.progress import Watch, clock

    opened = open_dataset(arguments.directory)
    place = opened.place
    again = command("extend", str(place), "--record", *arguments.record)

    def how_to_go_on() -> None:
        print(f"\ninterrupted; the dataset is as it was, and what is done is kept. Go on with:\n  {again}",
              file=sys.stderr)  # fmt: skip

    try:
        if is_there(opened, keys):
            print("to run  nothing: the dataset has these records", flush=True)
        elif opened.manifest.scene is None:
            _say(addition(opened, keys, arguments.accept_version), arguments.workers)
        if arguments.dry_run:
            return DONE
        with Watch(place) as watch, last_act(how_to_go_on):
            status = extend(
                opened, keys, arguments.workers, arguments.scheduler, watch, arguments.accept_version,
                arguments.dashboard,
            )  # fmt: skip
    except Interrupted as interrupt:
        how_to_go_on()
        return interrupt.exit_code
    print(printable(f"data    {place.named(DATA)}: {status.n_done} members, {status.n_bytes / 1e6:.2f} MB"))
    print(
        printable(
            f"scene   {place.named(SCENE)} has the new keys; to add members later, run that or add them to yours"
        )
    )
    own = ["--own"] * bool(own_questions.names(opened.scene))
    print(f"report  as before; rewrite it with: {command('report', str(place), *own)}")
    print(f"time    {clock(watch.elapsed)}")
    return DONE


def _give_up(directory: str) -> int:
    from stickslip.pipeline.dataset.extending import give_up
    from stickslip.pipeline.dataset.opened import open_dataset

    opened = open_dataset(directory)
    if opened.manifest.extension is None:
        print(printable(f"nothing to give up; no extension of {opened.place} is under way"))
        return DONE
    give_up(opened)
    print(printable(f"given up; {opened.place} is as it was before the extension was begun"))
    return DONE


def _say(found: Addition, workers: int) -> None:
    """What an extension takes."""
    from stickslip.pipeline.running.estimate import WITHIN
    from stickslip.workflows.progress import clock

    n_members = sum(len(batch.members) for batch, _ in found.todo)
    columns = [column.name for record in found.new for column in record.kept]
    print(f"columns {', '.join(columns)}", flush=True)
    if found.scene.run.purpose != found.before.scene.run.purpose:
        print(f"purpose {found.scene.run.purpose}: the runs keep the tolerances that were picked for it", flush=True)
    if not found.again:
        seconds = found.seconds_of_records
        took = f", in about {clock(seconds)} of a core" if seconds >= 1.0 else ""
        print(f"to run  nothing: computed from what is kept of {n_members} members{took}", flush=True)
        return
    print(f"to run  {found.n_again} of {n_members} members, again", flush=True)
    estimate = found.estimate(workers)
    for reason, count in estimate.failures.items():
        print(f"failed  {count} of the pilot: {printable(reason)}", flush=True)
    at = f"{estimate.workers} worker{'s' * (estimate.workers > 1)}"
    low, high = clock(estimate.seconds / WITHIN), clock(estimate.seconds * WITHIN)
    print(f"time    {clock(estimate.seconds)} ({low} to {high}) on {at}, not counting start", flush=True)


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
