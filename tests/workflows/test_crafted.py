"""Shards that somebody else wrote, under a manifest that fits: `verify` finds them, and readers refuse them."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stickslip.analysis.page import parts
from stickslip.pipeline import StoreError, expand, parse_scene, run_ensemble, verify
from stickslip.pipeline.dataset import sound
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.dataset.pages import UnsoundError
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.workflows.commands import main
from stickslip.workflows.reporting import report
from tests.pipeline.test_writer import forge
from tests.scenes import ensemble

N, T_END = 12, 40.0  # of the small scene: values are just beyond what they can be


def column(table, name, values):
    """The table with another column of a name, of the type that it has."""
    at = table.schema.get_field_index(name)
    return table.set_column(at, table.schema.field(at), pa.array(values, table.schema.field(at).type))


def first(table, name, change):
    """The table with another value in the first row."""
    values = table[name].to_pylist()
    values[0] = change(values[0])
    return column(table, name, values)


def of_type(table, name, kind):
    at = table.schema.get_field_index(name)
    return table.set_column(at, pa.field(name, kind, nullable=False), table[name].cast(kind))


def nullable(table, name):
    at = table.schema.get_field_index(name)
    values = [None, *table[name].to_pylist()[1:]]
    return table.set_column(at, pa.field(name, table.schema.field(at).type, True), pa.array(values))


CRAFTS = {
    "a column of another type": lambda table: of_type(table, "n", pa.int64()),
    "a column less": lambda table: table.drop_columns(["kappa"]),
    "a column more": lambda table: table.append_column("more", table["n"]),
    "null where there is none": lambda table: nullable(table, "kappa"),
    "NaN": lambda table: first(table, "t_stop", lambda _: np.nan),
    "infinite times": lambda table: first(table, "t", lambda t: [*t[:-1], np.inf]),
    "lists of unequal lengths": lambda table: first(table, "n_stick", lambda values: values[:-1]),
    "events of unequal lengths": lambda table: first(table, "event_mode", lambda values: [*values, 1]),
    "times out of order": lambda table: first(table, "event_t", lambda t: t[::-1]),
    "times before the start": lambda table: first(table, "event_t", lambda t: [-1.0, *t[1:]]),
    "times after the end": lambda table: first(table, "event_t", lambda t: [*t[:-1], T_END * (1 + 1e-9)]),
    "no start": lambda table: first(table, "t", lambda t: [0.1, *t[1:]]),
    "an empty series": lambda table: first(first(table, "t", lambda t: []), "n_stick", lambda values: []),
    "two changes at one time": lambda table: first(table, "t", lambda t: [*t[:2], t[1], *t[3:]]),
    "a run without a series": lambda table: first(first(table, "t", lambda t: None), "n_stick", lambda values: None),
    "a block that is none": lambda table: first(table, "event_block", lambda values: [N, *values[1:]]),
    "a block below none": lambda table: first(table, "event_block", lambda values: [-1, *values[1:]]),
    "a mode that is none": lambda table: first(table, "event_mode", lambda values: [2, *values[1:]]),
    "modes of too many blocks": lambda table: first(table, "initial_mode", lambda values: [*values, 0]),
    "a negative number of sticking blocks": lambda table: first(table, "n_stick", lambda values: [-5, *values[1:]]),
    "too many sticking blocks": lambda table: first(table, "n_stick", lambda values: [N + 1, *values[1:]]),
    "a negative count": lambda table: first(table, "n_steps", lambda _: -1),
    "an outcome that is none": lambda table: first(table, "outcome", lambda _: "won"),
    "another member's name": lambda table: first(table, "member_id", lambda name: f"{name}x"),
    "a name that is a command to a terminal": lambda table: first(table, "member_id", lambda name: "\x1b[31m"),
    "a row twice": lambda table: pa.concat_tables([table.slice(0, 1), table.slice(0, len(table) - 1)]),
    "another seed": lambda table: first(table, "seed", lambda seed: seed + 1),
    "another system": lambda table: first(table, "matrix", lambda _: -1),
    "another size": lambda table: first(table, "n", lambda n: n + 1),
    "another end": lambda table: first(table, "t_end", lambda t_end: t_end / 2),
    "a setting that its scene does not give": lambda table: first(table, "threshold", lambda _: 0.5),
    "another engine": lambda table: first(table, "engine", lambda _: "magic"),
    "counts that do not add up": lambda table: first(table, "n_events", lambda count: count + 1),
    "another last state": lambda table: first(table, "n_stick_end", lambda count: (count + 1) % 3),
    "the hash of another scene": lambda table: table.replace_schema_metadata({b"scene_hash": b"0"}),
    "no UTF-8": lambda table: table.set_column(
        table.schema.get_field_index("coupling"),
        table.schema.field("coupling"),
        pa.Array.from_buffers(pa.string(), len(table), [
            None,
            pa.array(np.arange(len(table) + 1, dtype=np.int32)).buffers()[1],
            pa.py_buffer(b"\xff" * len(table)),
        ]),
    ),
}  # fmt: skip
#: What a reader that does not look at these columns cannot see.
AUDITED = ("a negative count", "counts that do not add up", "another last state", "the hash of another scene")


@pytest.fixture
def place(dataset, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "d")
    shutil.rmtree(copy / "report")
    (copy / "report.html").unlink()
    return copy


def crafted(place, craft):
    """Put a crafted shard in the place of the first."""
    shard = min((place / "data").iterdir())
    table = craft(pq.read_table(shard))
    pq.write_table(table, shard, compression="zstd", write_page_checksum=True)
    forge(place, shard.name)
    return shard


@pytest.mark.parametrize("name", CRAFTS)
def test_a_crafted_shard_is_found(name, place, tmp_path, monkeypatch, capsys):
    """`verify` names it, a report is of what it looks at, and other readers say no more than a line."""
    shard = crafted(place, CRAFTS[name])
    assert main(["verify", str(place)]) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if str(shard) in line]
    assert line.isprintable()
    monkeypatch.setattr(parts, "draw", lambda *_, **__: parts.Drawn("<svg/>"))
    with contextlib.nullcontext() if name in AUDITED else pytest.raises(StoreError):
        report(place)
    for words in (
        ["query", str(place), "SELECT * FROM n_stick"],
        ["export", str(place), "--netcdf", str(tmp_path / "a.nc")],
    ):
        code = main(words)
        assert code in (0, 1, 2)
        assert capsys.readouterr().err.count("\n") == (code != 0)


def test_a_list_that_is_missing_beside_its_siblings_is_found(tmp_path):
    text = ensemble(3, 40.0, 2, seed=1, rest="[record]\nepisodes = true", analysis="t_burn = 1.0\ndt = 0.5")
    run_ensemble(parse_scene(text), tmp_path, workers=0)
    shard = crafted(tmp_path, lambda table: first(table, "episode_end", lambda _: None))
    (problem,) = verify(tmp_path)
    assert problem.startswith(f"{shard}: episode_end: expected as many values as of episode_start")


def test_a_first_block_that_is_none_is_found(tmp_path):
    """Blocks are numbered from zero, in a column of one number a run as in one of lists."""
    text = ensemble(3, 40.0, 2, seed=1, rest="[record]\nfirst_exit = true", analysis="t_burn = 1.0\ndt = 0.5")
    run_ensemble(parse_scene(text), tmp_path, workers=0)
    shard = crafted(tmp_path, lambda table: first(table, "first_exit_block", lambda _: 3))
    (problem,) = verify(tmp_path)
    assert problem.startswith(f"{shard}: first_exit_block: expected values from 0 to 2, got 3;")


def test_a_manifest_is_told_in_a_line_whatever_it_names(place, capsys):
    manifest = read_manifest(place)
    name, shard = next(iter(manifest.shards.items()))
    manifest.shards[name] = shard.model_copy(update={"outcomes": {"\x1b[31m" + "x" * 100_000: 1}})
    (place / "manifest.json").write_bytes(manifest.to_bytes())
    assert main(["verify", str(place)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert len(line) < 1000


#: kB that a command may take for what it does not read.
LITTLE = 200_000


def memory(key):
    """Of this process, in kB."""
    return int(re.search(rf"{key}:\s+(\d+)", Path("/proc/self/status").read_text())[1])


def refused(arguments, capsys):
    """What the command says, in one line of error; it takes little memory."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak is what it is now
    before = memory("VmRSS")
    code = main(arguments)
    assert memory("VmHWM") - before < LITTLE
    said = capsys.readouterr()
    assert (code, said.err.count("\n")) == (1, 1)
    return said.out + said.err


on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


def of_length(table, name, length):
    """The table with a first list of so many zeros, and no others."""
    field = table.schema.field(name)
    offsets = pa.array(np.array([0, *[length] * len(table)], np.int32))
    values = pa.array(np.zeros(length, field.type.value_type.to_pandas_dtype()))
    lists = pa.ListArray.from_arrays(offsets, values).cast(field.type)
    return table.set_column(table.schema.get_field_index(name), field, lists)


LARGE = {
    "lists": lambda table: of_length(of_length(table, "t", 20_000_000), "n_stick", 20_000_000),
    "texts": lambda table: column(table, "reason", ["x" * 8_000_000] * len(table)),
}


@on_linux
@pytest.mark.parametrize("name", LARGE)
def test_a_shard_that_would_fill_the_memory_is_not_read(name, place, capsys):
    """Small files: runs of one value, and one long text in each row."""
    assert crafted(place, LARGE[name]).stat().st_size < 200_000
    for words in (["verify", str(place)], ["query", str(place), "SELECT count(*) FROM n_stick"]):
        assert "MB" in refused(words, capsys)


def varint(number, n_bytes=0):
    """A whole number as Thrift has it, perhaps in more bytes than it needs."""
    left, parts = 2 * number, []
    while left or len(parts) < max(n_bytes, 1):
        parts.append(left % 128 | 128)
        left //= 128
    return bytes([*parts[:-1], parts[-1] & 127])


@on_linux
def test_a_footer_that_lies_about_its_pages_is_found_before_they_are_read(place, capsys):
    """It says of 20 million values that they are as many as there are rows, in as many bytes."""
    shard = min((place / "data").iterdir())
    table = LARGE["lists"](pq.read_table(shard))
    pq.write_table(table, shard, compression="zstd", write_page_checksum=True)
    content = shard.read_bytes()
    start = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    head = content[start:]
    group = pq.read_metadata(shard).row_group(0)
    columns = [column for k in range(group.num_columns) if (column := group.column(k)).num_values > 10**6]
    numbers = {number for column in columns for number in (column.num_values, column.total_uncompressed_size)}
    assert numbers
    for number in numbers:
        assert varint(number) in head
        head = head.replace(varint(number), varint(len(table), len(varint(number))))
    shard.write_bytes(content[:start] + head)
    assert shard.stat().st_size < 200_000
    forge(place, shard.name)
    for words in (["verify", str(place)], ["query", str(place), "SELECT count(*) FROM n_stick"]):
        assert "as its footer says" in refused(words, capsys)


def test_texts_that_repeat_the_one_before_are_no_encoding_of_ours(place):
    """A few bytes for each of any number of long texts."""
    shard = min((place / "data").iterdir())
    table = column(pq.read_table(shard), "coupling", ["x" * 10_000] * len(pq.read_table(shard)))
    pq.write_table(table, shard, use_dictionary=False, column_encoding={"coupling": "DELTA_BYTE_ARRAY"})
    with pytest.raises(UnsoundError, match="coupling: expected pages of known kinds"):
        sound.check_file(shard.read_bytes(), table.schema, len(table))


def no_utf8(shard, old):
    """Have a word of a footer, or of its statistics, be no text."""
    content = shard.read_bytes()
    start = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    assert old in content[start:]
    shard.write_bytes(content[:start] + content[start:].replace(old, b"\xff" * len(old)))
    forge(shard.parents[1], shard.name)


def test_a_footer_that_is_no_utf8_is_damage(place, capsys):
    shard = min((place / "data").iterdir())
    no_utf8(shard, b"coupling")
    assert main(["verify", str(place)]) == 1
    said = capsys.readouterr()
    (line,) = [line for line in said.out.splitlines() if str(shard) in line]
    assert "cannot be read (" in line
    assert said.err.count("\n") == 1


def test_statistics_are_not_looked_at(place, capsys):
    """Where they are no UTF-8 and are compared with a condition, Arrow waits for ever; wrong ones hide rows."""
    no_utf8(min((place / "data").iterdir()), b"antisymmetric")
    n_members = len(expand(open_dataset(place).scene))
    for condition in ("coupling = 'antisymmetric'", "coupling <> 'x'"):
        assert main(["query", str(place), f"SELECT count(*) AS n FROM members WHERE {condition}"]) == 0
        assert str(n_members) in capsys.readouterr().out.split()


def test_texts_of_all_row_groups_are_counted(place):
    """The last row group has none of the long ones."""
    shard = min((place / "data").iterdir())
    table = pq.read_table(shard)
    long = column(table, "coupling", ["x" * 50_000_000] * len(table))
    with pq.ParquetWriter(shard, table.schema, compression="zstd") as file:
        for part in (long, table):
            file.write_table(part)
    with pytest.raises(UnsoundError, match="expected at most"):
        sound.check_file(shard.read_bytes(), table.schema, 2 * len(table))


@on_linux
@pytest.mark.parametrize(
    "name", ["manifest.json", "scene.toml", ".lock", "timings.jsonl", "report/files.txt", "shard"]
)
def test_a_part_that_would_fill_the_memory_is_not_read(name, place, small_scene, here, capsys):
    part = min((place / "data").iterdir()) if name == "shard" else place / name
    part.parent.mkdir(exist_ok=True)
    part.touch()
    os.truncate(part, 6 * 2**30)
    Path("/proc/self/clear_refs").write_text("5")
    before = memory("VmRSS")
    for words in (["verify", str(place)], ["status", str(place)], ["report", str(place)]):
        assert main(words) in (0, 1)
    assert main(["run", str(small_scene), "--out", str(place), "--workers", "1", "--no-report"]) in (0, 1)
    assert memory("VmHWM") - before < LITTLE


def test_more_than_an_array_can_hold_is_a_fault_in_every_check(dataset):
    """Two lists of 2^31 - 1 nulls, which take no memory."""
    opened = open_dataset(dataset)
    lists = pa.ListArray.from_arrays(pa.array([0, 2**31 - 1], pa.int32()), pa.nulls(2**31 - 1))
    table = pa.table({"n_events": pa.chunked_array([lists, lists])})
    for check in (sound.check_counts, opened.sound.check):
        with pytest.raises(StoreError, match=r"it: cannot be read .*overflow"), sound.told_of("it"):
            check(table)
    with pytest.raises(StoreError), sound.told_of("it"):
        sound.check_members(table.rename_columns(["member_id"]), expand(opened.scene)[:2], None)


@on_linux
def test_a_shard_of_holes_is_not_read_though_its_manifest_fits(place, capsys):
    """The manifest says 6 GB, too."""
    shard = min((place / "data").iterdir())
    os.truncate(shard, 6 * 2**30)
    manifest = read_manifest(place)
    manifest.shards[shard.name] = manifest.shards[shard.name].model_copy(update={"bytes": 6 * 2**30})
    (place / "manifest.json").write_bytes(manifest.to_bytes())
    for words in (["verify", str(place)], ["query", str(place), "SELECT * FROM members"]):
        refused(words, capsys)
