"""The place at a path or an address: a directory, or by fsspec an object store (``s3://bucket/dir``, ``gs://``)."""

from __future__ import annotations

from pathlib import Path

from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.place import Place, Where


def place_of(where: Where) -> Place:
    """The place at a path or an address.

    Raises `StoreError` if the address is of no store that fsspec knows, or the package for it is missing.
    """
    if isinstance(where, Place):
        return where
    if not (isinstance(where, str) and "://" in where):
        return Directory(Path(where))
    address = where.rstrip("/")
    protocol, _, path = address.partition("://")
    if protocol in ("file", "local"):
        return Directory(Path(path))
    if not path.strip("/"):
        raise StoreError(f"{where}: expected an address such as s3://bucket/dir, got only its beginning")
    import fsspec  # with what it loads, a tenth of a second

    from stickslip.pipeline.places.object_store import Prefix

    try:
        # no cached listings: other processes write there
        system, root = fsspec.core.url_to_fs(address, use_listings_cache=False)
    except ImportError as error:
        remedy = 'run: pip install "stickslip[s3]"' if protocol == "s3" else str(error)
        raise StoreError(f"{address}: expected the package for {protocol}://, got none; {remedy}") from error
    except ValueError as error:
        raise StoreError(
            f"{address}: expected a directory or an address such as s3://bucket/dir, got one that fsspec cannot open "
            f"({error}); correct it"
        ) from error
    return Prefix(address, system, root.rstrip("/"))
