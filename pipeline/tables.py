"""Table schemas (JSON) -> Arrow; the one place where Parquet is written and read.

A table of the run folder is described once, in ``schemas/tables/<name>.json``: each column's name, type, unit,
frame and meaning. Nothing re-declares them in Python: what is written is checked against that file, and what is
read must say that it was written by the same version of it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from pipeline import resources
from pipeline.errors import ArtefactError
from pipeline.runs import atomic_file

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

Columns = Mapping[str, Any]

NULL_INT = int(np.iinfo(np.int64).min)
"""Null in a nullable integer column, in memory; numpy's NaT is the same number."""

ROW_GROUP = 131_072
"""Rows of one row group: small enough to be skipped when a time span is asked for, large enough to compress."""


@dataclass(frozen=True)
class Column:
    name: str
    type: str
    """float64, float32, int64, int32, bool or string."""
    unit: str
    meaning: str
    frame: str = ""
    nullable: bool = False


@dataclass(frozen=True)
class TableSchema:
    name: str
    version: int
    meaning: str
    columns: tuple[Column, ...]

    @property
    def column_names(self) -> tuple[str, ...]:
        return tuple(column.name for column in self.columns)

    def arrow(self, metadata: Mapping[str, str] | None = None) -> pa.Schema:
        """The Arrow schema; unit, frame and meaning travel in each field's metadata."""
        import pyarrow as pa

        fields = []
        for column in self.columns:
            facts = {"unit": column.unit, "frame": column.frame, "meaning": column.meaning}
            fields.append(
                pa.field(
                    column.name,
                    _arrow_type(column.type),
                    nullable=column.nullable,
                    metadata={key: value for key, value in facts.items() if value},
                )
            )
        own = {"gradetrace.table": self.name, "gradetrace.version": str(self.version)}
        return pa.schema(fields, metadata={**own, "gradetrace.meaning": self.meaning, **(metadata or {})})


@cache
def read_schema(name: str) -> TableSchema:
    """The schema of a table, from ``schemas/tables/<name>.json``."""
    data = json.loads(resources.schema_text(f"tables/{name}.json"))
    assert data["table"] == name, name
    columns = tuple(Column(**column) for column in data["columns"])
    return TableSchema(name, int(data["version"]), data["meaning"], columns)


def empty_columns(name: str) -> dict[str, np.ndarray]:
    """The columns of a table without rows."""
    return {column.name: np.zeros(0, _numpy_type(column.type)) for column in read_schema(name).columns}


def write_table(path: Path, name: str, columns: Columns, metadata: Mapping[str, str] | None = None) -> None:
    """Write a table as Parquet, whole or not at all; the same columns give the same bytes.

    Parameters
    ----------
    path : Path
        Ends in ``.parquet``; folders on the way are made.
    name : str
        The table: ``schemas/tables/<name>.json``.
    columns : dict of arrays or lists of equal length
        Exactly the schema's columns, in any order. NaN in a nullable float column is stored as null; so is None in
        a nullable string column and `NULL_INT` in a nullable integer column.
    metadata : dict of strings, optional
        Kept in the file beside the table's name and version.

    Raises
    ------
    ValueError, TypeError
        The columns are not the schema's: a defect of ours.
    ArtefactError
        The disk is full or the folder cannot be written to.
    """
    with table_writer(path, name, metadata) as writer:
        writer.write(columns)


@contextmanager
def table_writer(path: Path, name: str, metadata: Mapping[str, str] | None = None) -> Iterator[TableWriter]:
    """A writer of a table in portions, for what does not fit into memory; the file appears on leaving the block."""
    with atomic_file(Path(path)) as stream:
        writer = TableWriter(stream, read_schema(name), metadata)
        try:
            yield writer
        finally:
            # Also after an error: Arrow would otherwise write a footer into a closed file later on.
            writer.close()


class TableWriter:
    """Appends portions of rows; each portion becomes row groups of its own."""

    def __init__(self, stream: BinaryIO, schema: TableSchema, metadata: Mapping[str, str] | None = None):
        import pyarrow.parquet as pq

        self.schema = schema
        self.arrow_schema = schema.arrow(metadata)
        self._writer = pq.ParquetWriter(
            stream,
            self.arrow_schema,
            compression="zstd",
            compression_level=3,
            use_dictionary=[column.name for column in schema.columns if column.type == "string"],
            # Neighbouring doubles share sign and exponent: split into byte planes they compress a third better.
            column_encoding={
                column.name: "BYTE_STREAM_SPLIT"
                for column in schema.columns
                if column.type.startswith("float")
            },
            # Parquet has no checksum of its own: a flipped bit would come back as a plausible number.
            write_page_checksum=True,
        )

    def write(self, columns: Columns) -> None:
        """Append rows; see `write_table` for what `columns` may hold."""
        import pyarrow as pa

        wanted = self.schema.column_names
        if set(columns) != set(wanted):
            missing, foreign = set(wanted) - set(columns), set(columns) - set(wanted)
            raise ValueError(
                f"table {self.schema.name}: missing columns {sorted(missing)}, unknown columns {sorted(foreign)}"
            )
        arrays = [_to_arrow(columns[column.name], column, self.schema.name) for column in self.schema.columns]
        if len({len(array) for array in arrays}) > 1:
            lengths = {name: len(array) for name, array in zip(wanted, arrays)}
            raise ValueError(f"table {self.schema.name}: columns differ in length: {lengths}")
        self._writer.write_table(
            pa.Table.from_arrays(arrays, schema=self.arrow_schema), row_group_size=ROW_GROUP
        )

    def close(self) -> None:
        self._writer.close()


def read_table(
    path: Path, name: str, columns: list[str] | None = None, at_ns: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Columns of a table by name, all of them or those asked for.

    Parameters
    ----------
    path, name
        As for `write_table`.
    columns : list of str, optional
        Those that are wanted.
    at_ns : (k,) int64 array, optional
        Only rows whose `time_ns` is one of these. Row groups of other times are not read, and one is in memory at
        a time: a few instants of a shift cost a few row groups.

    Returns
    -------
    dict of (n,) arrays
        In the schema's types; strings as object arrays (None where null), null floats as NaN, null integers as
        `NULL_INT`.

    Raises
    ------
    ArtefactError
        The file is missing, damaged, another table, or of another version of the schema.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path, schema = Path(path), read_schema(name)
    chosen = [column for column in schema.columns if columns is None or column.name in columns]
    assert columns is None or len(chosen) == len(set(columns)), (name, columns)
    try:
        facts = pq.read_schema(path).metadata or {}
        found = (facts.get(b"gradetrace.table", b"").decode(), facts.get(b"gradetrace.version", b"").decode())
        if found != (name, str(schema.version)):
            raise ArtefactError(
                f"{path} holds {found[0] or 'no'} table, version {found[1] or 'unknown'}; expected {name}, "
                f"version {schema.version}; run 'gradetrace report' again to make it anew"
            )
        words = [column.name for column in chosen if column.type == "string"]
        with pq.ParquetFile(path, read_dictionary=words, page_checksum_verification=True) as file:
            names = [column.name for column in chosen]
            table = file.read(columns=names) if at_ns is None else _rows_at(file, names, at_ns)
        return {column.name: _to_numpy(table[column.name], column) for column in chosen}
    except FileNotFoundError:
        raise ArtefactError(f"{path} is missing; run 'gradetrace report' again to make it") from None
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ArtefactError(
            f"{path} is damaged ({reason}); delete it and run 'gradetrace report' again to make it anew"
        ) from error


def _rows_at(file: pq.ParquetFile, names: list[str], at_ns: np.ndarray) -> pa.Table:
    """Rows of some instants, in the order of the file."""
    import pyarrow as pa
    import pyarrow.compute as pc

    at_ns = np.unique(np.asarray(at_ns, np.int64))
    wanted = pa.array(at_ns, pa.int64())
    place = file.schema_arrow.get_field_index("time_ns")
    assert place >= 0, "only tables with time_ns can be asked for instants"
    found = [file.schema_arrow.empty_table().select(names)]
    for group in range(file.num_row_groups):
        limits = file.metadata.row_group(group).column(place).statistics
        if limits is not None and limits.has_min_max:
            first, last = np.searchsorted(at_ns, [limits.min, limits.max + 1])
            if first == last:
                continue
        rows = file.read_row_group(group, columns=[*dict.fromkeys([*names, "time_ns"])])
        found.append(rows.filter(pc.is_in(rows["time_ns"], wanted)).select(names))
    return pa.concat_tables(found)


def table_metadata(path: Path) -> dict[str, str]:
    """The metadata that a table was written with. Raises ArtefactError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        facts = pq.read_schema(path).metadata or {}
    except (pa.ArrowException, OSError) as error:
        raise ArtefactError(
            f"{path} is missing or damaged; run 'gradetrace report' again to make it"
        ) from error
    return {key.decode(): value.decode() for key, value in facts.items() if not key.startswith(b"ARROW:")}


def _arrow_type(name: str) -> pa.DataType:
    import pyarrow as pa

    return {
        "float64": pa.float64(),
        "float32": pa.float32(),
        "int64": pa.int64(),
        "int32": pa.int32(),
        "bool": pa.bool_(),
        "string": pa.string(),
    }[name]


def _numpy_type(name: str) -> np.dtype:
    return np.dtype(object if name == "string" else name)


def _to_arrow(values: Any, column: Column, table: str) -> pa.Array:
    import pyarrow as pa

    where = f"table {table}, column {column.name}"
    kind = _arrow_type(column.type)
    if column.type == "string":
        array = pa.array(list(values) if not isinstance(values, np.ndarray) else values.tolist(), type=kind)
    else:
        if column.nullable and not isinstance(values, np.ndarray):
            null = NULL_INT if column.type.startswith("int") else np.nan
            values = [null if value is None else value for value in values]
        data = np.asarray(values)
        if data.ndim != 1:
            raise ValueError(f"{where}: expected one dimension, found shape {data.shape}")
        allowed = {"float": "fiu", "int": "iu", "bool": "b"}[column.type.rstrip("0123456789")]
        if data.size and data.dtype.kind not in allowed:
            raise TypeError(f"{where}: expected {column.type}, found {data.dtype}")
        null_mask = None
        if column.type.startswith("float") and column.nullable:
            null_mask = np.isnan(data.astype(column.type, copy=False))
        elif column.nullable and column.type.startswith("int"):
            null_mask = data == NULL_INT
        if column.type == "int32" and data.size and (data.min() < -(2**31) or data.max() >= 2**31):
            raise ValueError(f"{where}: does not fit into int32")
        if column.type.startswith("float") and not column.nullable and np.isnan(data.astype(float)).any():
            raise ValueError(
                f"{where}: NaN in {int(np.isnan(data).sum())} of {len(data)} rows, must not be null"
            )
        if null_mask is not None and not null_mask.any():
            null_mask = None
        array = pa.array(
            np.ascontiguousarray(data.astype(column.type, copy=False)), type=kind, mask=null_mask
        )
    if array.null_count and not column.nullable:
        raise ValueError(f"{where}: {array.null_count} of {len(array)} rows are null, none may be")
    return array


def _to_numpy(chunked: pa.ChunkedArray, column: Column) -> np.ndarray:
    import pyarrow as pa
    import pyarrow.compute as pc

    if column.type == "string":
        # Through the dictionary, so that a million rows of three names are a million pointers and three strings.
        array = (
            chunked.unify_dictionaries().combine_chunks() if chunked.num_chunks else chunked.combine_chunks()
        )
        if isinstance(array, pa.ChunkedArray):
            return np.array(array.to_pylist(), dtype=object)
        if not isinstance(array, pa.DictionaryArray):
            return np.array(array.to_pylist() + [None], dtype=object)[:-1]
        words = np.array([*array.dictionary.to_pylist(), None], dtype=object)
        return words[pc.fill_null(array.indices, len(words) - 1).to_numpy(zero_copy_only=False)]
    if chunked.null_count and column.type.startswith("int"):
        chunked = pc.fill_null(chunked.cast(pa.int64()), NULL_INT)
        return chunked.to_numpy()
    return np.array(chunked.to_numpy(), dtype=_numpy_type(column.type))
