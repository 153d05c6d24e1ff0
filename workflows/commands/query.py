"""`stickslip query` and `export`: what a dataset holds, as a person or another program wants it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from stickslip.pipeline.errors import printable
from stickslip.pipeline.machine.signals import Interrupted
from stickslip.workflows.commands.command import DONE, Command


class Query(Command):
    """Query a dataset in SQL (views: members, n_stick, cascades, ...)."""

    examples = (
        ('stickslip query runs/quick "SELECT outcome, count(*) FROM members GROUP BY outcome"', ""),
        ('stickslip query runs/quick "SELECT * FROM n_stick" --out n_stick.parquet', ""),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")
        parser.add_argument("sql", metavar="SQL")
        parser.add_argument(
            "--format",
            choices=("table", "csv", "parquet", "mat"),
            help="format of the answer (default: from the ending of FILE, else a table)",
        )
        parser.add_argument(
            "--out", type=Path, metavar="FILE", help="file to write the answer to (default: standard output)"
        )

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.pipeline.query import answer
        from stickslip.workflows.export import form_of, write

        form = form_of(arguments.format, arguments.out)
        try:
            with answer(arguments.directory, arguments.sql) as batches:
                write(batches, form, arguments.out, arguments.directory)
        except Interrupted as interrupt:
            print("\ninterrupted; no answer was written", file=sys.stderr)
            return interrupt.exit_code
        return DONE


class Export(Command):
    """Write a dataset as one file of another form."""

    examples = (
        ("stickslip export runs/quick --netcdf quick.nc", "for xarray and others"),
        ("stickslip export runs/burridge_knopoff --catalogue events.csv", "a row an event, as ObsPy reads them"),
        ('stickslip query runs/quick "SELECT * FROM members" --out members.csv', "CSV is the answer to a query"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")
        forms = parser.add_mutually_exclusive_group(required=True)
        forms.add_argument("--netcdf", type=Path, metavar="FILE", help="file to write, in NetCDF-4")
        forms.add_argument("--catalogue", type=Path, metavar="FILE", help="file to write, in CSV, a row an event")

    def __call__(self, arguments: argparse.Namespace) -> int:
        if arguments.catalogue is not None:
            from stickslip.workflows import catalogue

            catalogue.write(arguments.directory, arguments.catalogue)
        else:
            from stickslip.workflows import netcdf

            netcdf.write(arguments.directory, arguments.netcdf)
        print(printable(f"data    {arguments.catalogue or arguments.netcdf}"))
        return DONE
