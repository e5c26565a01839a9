"""A row of the vector index, and the Arrow table that rows become."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.store.vector_filter import wrapped

_FORMAT = "georef.vectors.1"


@dataclass(frozen=True, eq=False)
class IndexRow:
    """What the index holds of one image."""

    key: str  # epoch/image_id
    position_in_world: NDArray[np.float64]  # (3,) of the camera, metres
    heading_rad: float | None  # direction of view in the horizontal plane; None: all round, or not known
    epoch: str
    camera: str
    descriptor: NDArray[np.float32]  # (D,)


def schema_of(version: str, size: int) -> Any:
    """The Arrow schema of an index: its columns, and in its metadata what its descriptors are."""
    import pyarrow as pa

    columns = [
        pa.field("key", pa.string(), nullable=False),
        *(pa.field(name, pa.float64(), nullable=False) for name in "xyz"),
        pa.field("heading_rad", pa.float64()),  # [0, 2 pi)
        pa.field("epoch", pa.string(), nullable=False),
        pa.field("camera", pa.string(), nullable=False),
        pa.field("descriptor", pa.list_(pa.float32(), size), nullable=False),
    ]
    return pa.schema(columns, metadata={"format": _FORMAT, "descriptor_version": version, "descriptor_size": str(size)})


def schema_problem(found: Any, expected: Any) -> str:
    """Why a stored table is not one of the expected descriptors; empty where it is."""
    there = {key.decode(): value.decode() for key, value in (found.metadata or {}).items()}
    for raw_key, raw_value in expected.metadata.items():
        key, value = raw_key.decode(), raw_value.decode()
        if there.get(key) != value:
            return f"its {key.replace('_', ' ')} is '{there.get(key, 'none')}', expected '{value}'"
    return "" if found.equals(expected) else f"its columns are {found.names}, expected {expected.names}"


def batch_of(rows: Iterable[IndexRow], schema: Any) -> Any:
    """The Arrow table of some rows. Raises ValueError, naming the key, for values that cannot be stored."""
    import pyarrow as pa

    rows = list(rows)
    size = schema.field("descriptor").type.list_size
    for row in rows:
        _check(row, size)
    positions = np.array([row.position_in_world for row in rows], float)
    descriptors = np.concatenate([row.descriptor for row in rows], dtype=np.float32)
    headings = [None if row.heading_rad is None else wrapped(row.heading_rad) for row in rows]
    columns = [
        pa.array([row.key for row in rows], pa.string()),
        *(pa.array(column) for column in positions.T.copy()),
        pa.array(headings, pa.float64()),
        pa.array([row.epoch for row in rows], pa.string()),
        pa.array([row.camera for row in rows], pa.string()),
        pa.FixedSizeListArray.from_arrays(pa.array(descriptors), size),
    ]
    return pa.Table.from_arrays(columns, schema=schema)


def _check(row: IndexRow, size: int) -> None:
    position, descriptor = np.asarray(row.position_in_world, float), np.asarray(row.descriptor)
    if not row.key:
        raise ValueError("a row of the vector index needs a key")
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"the position of '{row.key}' must be three finite numbers, got {row.position_in_world}")
    if row.heading_rad is not None and not math.isfinite(row.heading_rad):
        raise ValueError(f"the heading of '{row.key}' must be finite or None, got {row.heading_rad}")
    if descriptor.shape != (size,) or not np.isfinite(descriptor).all():
        raise ValueError(f"the descriptor of '{row.key}' must be {size} finite values, got shape {descriptor.shape}")
