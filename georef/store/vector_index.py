"""Global descriptors of all images of a map on disk: the nearest of those near a place, looking the same way.

A table of LanceDB in one folder: written in batches that are there as a whole or not at all, whatever kills the
writer; readers see the last complete state. Writers take turns by a lock file. This is the only module that imports
lancedb (2 s, 150 MB), and it does so when a table is first opened. Its threads do not survive a fork: start workers by
spawn.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from georef.errors import StageError
from georef.store.vector_filter import condition, one_of
from georef.store.vector_rows import IndexRow, batch_of, schema_of, schema_problem

_TABLE = "images"
_BATCH_BYTES = 32 * 2**20  # of descriptors, written and committed together
_MOST_ROWS = 16_384  # in a batch
_NAMED_AT_ONCE = 1000  # keys in one condition
_SORTED = ("key", "x", "y", "heading_rad")  # columns with a B-tree
_LARGE_ROWS = 100_000  # from here on a search of the whole map takes the vector index
_PROBES, _REFINE = 400, 20  # partitions searched, and exact distances for this many times k: measured at a million
KEEP_OLD_FOR = timedelta(minutes=10)  # no query takes that long


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Keys of the images whose descriptors are nearest, the nearest first."""

    keys: tuple[str, ...]
    distances: NDArray[np.float32]  # (n,) Euclidean, in descriptor space

    def __len__(self) -> int:
        return len(self.keys)


class VectorIndex:
    """Descriptors of one version and size with place, heading, epoch and camera of their images, in `folder`.

    version: what decides the descriptors (component, weights, settings); size: their dimension. An index that was
    made with others is refused with StageError by the first call that opens it. Where nothing was stored yet, the index
    is empty. May be sent to other processes: only folder, version and size travel.
    """

    def __init__(self, folder: Path, *, version: str, size: int) -> None:
        self._folder, self._version, self._size = folder, version, size
        self._opened: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}

    def upsert(self, rows: Iterable[IndexRow]) -> int:
        """Insert rows, or replace those whose key is there already; returns how many were given.

        Rows are taken and committed batch by batch (32 MB of descriptors): memory does not grow with their number, and
        what was committed before an error or the end of the process stays. Of rows with the same key the last one
        counts. Raises ValueError for a row that cannot be stored, with its key.
        """
        remaining, count = iter(rows), 0
        most = max(1, min(_MOST_ROWS, _BATCH_BYTES // (4 * self._size)))
        while part := list(islice(remaining, most)):
            batch = batch_of({row.key: row for row in part}.values(), self._schema())
            with self._writing():
                merge = self._table().merge_insert("key").when_matched_update_all().when_not_matched_insert_all()
                merge.execute(batch)
            count += len(part)
        return count

    def delete(self, keys: Iterable[str]) -> int:
        """Remove these images; returns how many were there."""
        remaining, count = iter(keys), 0
        while part := list(islice(remaining, _NAMED_AT_ONCE)):
            with self._writing():
                count += self._table().delete(one_of("key", part)).num_deleted_rows
        return count

    def keys(self) -> set[str]:
        """The keys of all images; nothing else is read."""
        if not self._exists():
            return set()
        batches = self._table().search().select(["key"]).to_batches(65_536)
        return {key for batch in batches for key in batch.column("key").to_pylist()}

    def __len__(self) -> int:
        return self._table().count_rows() if self._exists() else 0

    def nearest(
        self,
        descriptor: ArrayLike,
        k: int,
        *,
        centre: ArrayLike | None = None,
        half_side_m: float | None = None,
        heading_rad: float | None = None,
        heading_window_deg: float | None = None,
        epochs: Sequence[str] | None = None,
    ) -> Neighbours:
        """The k images with the nearest descriptors, or as many as pass the filters.

        centre (2,) or (3,) with half_side_m: images inside the square x, y +- half_side_m, in world metres.
        heading_rad with heading_window_deg: images whose heading is within +- the window, and those without one.
        epochs: images of these epochs. Filtered searches are exact. Without any filter the whole map is searched,
        through the vector index where `optimize` has made one, else exactly.
        Raises ValueError for a descriptor (size,) of another size or not finite, and for half a filter.
        """
        query = np.asarray(descriptor, np.float32)
        if query.shape != (self._size,) or not np.isfinite(query).all():
            raise ValueError(f"expected {self._size} finite values as descriptor, got shape {query.shape}")
        where = condition(centre, half_side_m, heading_rad, heading_window_deg, epochs)
        if k <= 0 or not self._exists():
            return Neighbours((), np.zeros(0, np.float32))
        search = self._table().search(query, vector_column_name="descriptor").distance_type("l2")
        if where is None:
            search = search.nprobes(_PROBES).refine_factor(_REFINE)
        else:
            search = search.where(where, prefilter=True).bypass_vector_index()
        found = search.select(["key", "_distance"]).limit(k).to_arrow()
        squared = found.column("_distance").to_numpy()
        return Neighbours(tuple(found.column("key").to_pylist()), np.sqrt(np.maximum(squared, 0)).astype(np.float32))

    def optimize(self, *, keep_old_for: timedelta = KEEP_OLD_FOR) -> None:
        """Build or complete the indices, join small files, and remove states older than `keep_old_for`.

        Worth its while after large changes; queries are right without it, only slower. Replaced files stay on
        disk as long as a reader might use them, and go with a later call. The vector index is made from 100,000 images
        on, where the descriptor's size is a multiple of 8; without it the whole map is searched exactly.
        """
        if not self._exists():
            return
        from lancedb.index import Bitmap, BTree, IvfRq

        wanted: dict[str, Any] = {"epoch": Bitmap()} | dict.fromkeys(_SORTED, BTree())
        with self._writing():
            table = self._table()
            table.optimize(cleanup_older_than=keep_old_for)
            if self._size % 8 == 0 and table.count_rows() >= _LARGE_ROWS:
                wanted["descriptor"] = IvfRq(distance_type="l2")
            there = {column for index in table.list_indices() for column in index.columns}
            for column, kind in wanted.items():
                if column not in there:
                    table.create_index(column, config=kind)

    def _schema(self) -> Any:
        return schema_of(self._version, self._size)

    def _exists(self) -> bool:
        return (self._folder / f"{_TABLE}.lance" / "_versions").is_dir()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """One writer at a time; the system releases the lock of a process that dies."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with (self._folder / "writer.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _table(self) -> Any:
        """The table, made where there is none; each use of it sees the latest state."""
        if self._opened is None:
            self._opened = self._open()
        return self._opened

    def _open(self) -> Any:
        import lancedb

        remedy = f"Delete the folder and index the images again.\nIn {self._folder}"
        try:
            database = lancedb.connect(self._folder, read_consistency_interval=timedelta(0))
            make = database.open_table if self._exists() else partial(database.create_table, schema=self._schema())
            table = make(_TABLE)
            problem = schema_problem(table.schema, self._schema())
        except (RuntimeError, ValueError) as error:
            raise StageError(f"The vector index cannot be opened: {error}.\n{remedy}") from error
        if problem:
            raise StageError(f"The vector index cannot be used: {problem}.\n{remedy}")
        return table
