"""Opening a dataset to read: the shards that the manifest lists, and the words for what cannot be read or asked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds

from pipeline.errors import QueryError, StoreError
from pipeline.manifest import dataset_scene, read_manifest
from pipeline.place import DATA, Directory, Where, place_of
from pipeline.shards import Recording
from sim.arguments import did_you_mean

# pandas' plain types have no null but NaN; these do, and keep integers integers
NULLABLE = {
    pa.int32(): pd.Int32Dtype(),
    pa.int64(): pd.Int64Dtype(),
    pa.float64(): pd.Float64Dtype(),
    pa.bool_(): pd.BooleanDtype(),
    pa.string(): pd.StringDtype(),
}

#: What is there if the scene asks for it: by which line, in which of its tables.
RECORDED_BY = {
    "events": "`events = true` under [record]",
    "separation": "`separation = 5.0` under [record]",
    "thresholds": '`thresholds = [0.5, 1.0, 2.0]` under [[engine]] name = "sigmoid"',
}


def dataset(path: Where, shards: Sequence[str] | None = None) -> ds.Dataset:
    """The shards that the manifest lists, or some of them, as one Arrow dataset, in the order of their names.

    Raises
    ------
    StoreError
        If there is no readable dataset at `path`.
    """
    place = place_of(path)
    names = sorted(read_manifest(place).shards) if shards is None else shards
    schema = Recording.of(dataset_scene(place)).schema
    checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    with reading(place):
        return ds.dataset(
            [place.key(f"{DATA}/{name}") for name in names],
            schema=schema,
            filesystem=place.arrow,
            format=ds.ParquetFileFormat(default_fragment_scan_options=checked),
        )


@contextlib.contextmanager
def reading(path: Where) -> Iterator[None]:
    """Turn what a damaged or missing shard raises into words that say what to do."""
    try:
        yield
    except (OSError, pa.ArrowInvalid) as error:  # a file that is gone, a page whose checksum is wrong, a stump
        if isinstance(error, pa.ArrowInvalid) and "Parquet" not in str(error):
            raise
        raise unreadable(path, error) from error


def unreadable(path: Where, error: Exception) -> StoreError:
    """The refusal of a dataset of which a shard cannot be read."""
    place = place_of(path)
    first = "" if isinstance(place, Directory) else f"{place.remedy}, or "
    return StoreError(f"{place}: a shard cannot be read ({error}); {first}run the scene again to rebuild it")


def frame(table: pa.Table) -> pd.DataFrame:
    """A table as a data frame: a column that holds nulls has a nullable type (NA, never NaN), others a plain one."""
    plain = [name for name in table.column_names if table[name].null_count == 0]
    nullable = table.to_pandas(types_mapper=NULLABLE.get)
    types = {name: table.schema.field(name).type for name in plain}
    return nullable.astype({name: plain_type(kind) for name, kind in types.items() if kind in NULLABLE})


def plain_type(kind: pa.DataType) -> type:
    """Pandas' own type of a column without nulls."""
    return str if pa.types.is_string(kind) else kind.to_pandas_dtype()  # which would be `object`


def not_recorded(part: str) -> QueryError:
    """The refusal of what the scene did not ask for, a key of `RECORDED_BY`."""
    return QueryError(f"{part}: expected a dataset with {part}, got one without; set {RECORDED_BY[part]}")


def near(word: str, known: Sequence[str]) -> str:
    """What `word` may have been meant for, as the end of a message."""
    return did_you_mean(word, known) or f"; there are {', '.join(known[:10])}{', ...' * (len(known) > 10)}"
