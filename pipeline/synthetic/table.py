"""Truth tables as Parquet. Not artefacts: no stage may read them, so no schema of the house covers them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write columns as one small Parquet file with the same bytes each time."""
    table = pa.table({name: pa.array(values) for name, values in columns.items()})
    floats = [name for name in table.column_names if pa.types.is_floating(table.schema.field(name).type)]
    others = [name for name in table.column_names if name not in floats]
    pq.write_table(
        table,
        path,
        compression="zstd",
        use_dictionary=others,
        use_byte_stream_split=floats,
        write_statistics=False,
    )


def read(path: Path) -> dict[str, np.ndarray]:
    """Columns of a truth table; for tests and benchmarks."""
    table = pq.read_table(path)
    return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
