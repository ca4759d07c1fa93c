"""Parquet that is checked on the way in, checked on the way out, and the same to the byte each time."""

import json
import resource
import signal

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline import resources, tables
from pipeline.errors import ArtefactError

TABLES = sorted(path.stem for path in (resources.schema_folder() / "tables").glob("*.json"))


def random_columns(name, rows, seed=0):
    """Columns of a table with every kind of value, nulls where they are allowed."""
    rng = np.random.default_rng(seed)
    columns = {}
    for column in tables.read_schema(name).columns:
        if column.type == "string":
            values = np.array(["cut", "über", "", "x" * 40], object)[rng.integers(0, 4, rows)]
            if column.nullable:
                values[::5] = None
        elif column.type == "bool":
            values = rng.integers(0, 2, rows).astype(bool)
        elif column.type.startswith("int"):
            values = rng.integers(-1000, 1000, rows).astype(column.type)
            if column.nullable:
                values[::4] = tables.NULL_INT
        else:
            values = rng.normal(size=rows).astype(column.type)
            if column.nullable:
                values[::3] = np.nan
        columns[column.name] = values
    return columns


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("rows", [0, 1, 1000])
def test_every_table_survives_a_round_trip(tmp_path, name, rows):
    columns = random_columns(name, rows)
    tables.write_table(tmp_path / "t.parquet", name, columns)
    found = tables.read_table(tmp_path / "t.parquet", name)
    assert list(found) == list(tables.read_schema(name).column_names)
    for key, values in columns.items():
        np.testing.assert_array_equal(found[key], values, err_msg=key)
        assert found[key].dtype == values.dtype, key


@pytest.mark.parametrize("name", TABLES)
def test_schema_describes_every_column(name):
    schema = json.loads(resources.schema_text(f"tables/{name}.json"))
    assert schema["version"] >= 1
    assert schema["meaning"].endswith(".")
    names = [column["name"] for column in schema["columns"]]
    assert len(set(names)) == len(names)
    for column in schema["columns"]:
        assert (
            {"name", "type", "unit", "meaning"}
            <= set(column)
            <= {"name", "type", "unit", "meaning", "frame", "nullable"}
        )
        assert column["type"] in {"float64", "float32", "int64", "int32", "bool", "string"}
        assert column["meaning"]


def test_same_columns_give_the_same_bytes(tmp_path):
    for file in ("a.parquet", "b.parquet"):
        tables.write_table(tmp_path / file, "poses", random_columns("poses", 5000), {"note": "x"})
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.parquet", "b.parquet"]


def test_file_is_plain_parquet_with_units_nulls_and_metadata(tmp_path):
    columns = random_columns("as_built", 30)
    tables.write_table(tmp_path / "t.parquet", "as_built", columns, {"site": "TRENCH-7"})
    table = pq.read_table(tmp_path / "t.parquet")
    assert table["h"].null_count == 10
    assert table["lowest_time_ns"].null_count == 8
    assert table.schema.field("h").metadata == {
        b"unit": b"m",
        b"frame": b"grid",
        b"meaning": b"as-built elevation, lowest-of-many bias removed",
    }
    assert not table.schema.field("station").nullable
    column = pq.ParquetFile(tmp_path / "t.parquet").metadata.row_group(0).column(3)
    assert column.compression == "ZSTD"
    assert "BYTE_STREAM_SPLIT" in column.encodings
    facts = tables.table_metadata(tmp_path / "t.parquet")
    assert (facts["gradetrace.table"], facts["gradetrace.version"], facts["site"]) == (
        "as_built",
        "1",
        "TRENCH-7",
    )


def test_chosen_columns_only(tmp_path):
    columns = random_columns("checks", 7)
    tables.write_table(tmp_path / "t.parquet", "checks", columns)
    found = tables.read_table(tmp_path / "t.parquet", "checks", ["z", "point"])
    assert sorted(found) == ["point", "z"]


def test_portions_give_the_rows_of_one_piece(tmp_path):
    columns = random_columns("checks", 700)
    with tables.table_writer(tmp_path / "t.parquet", "checks") as writer:
        for start in range(0, 700, 300):
            writer.write({key: values[start : start + 300] for key, values in columns.items()})
    found = tables.read_table(tmp_path / "t.parquet", "checks")
    for key, values in columns.items():
        np.testing.assert_array_equal(found[key], values)


def test_rows_of_some_instants_are_those_of_the_whole_table(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "ROW_GROUP", 100)
    columns = random_columns("residuals", 5000)
    rng = np.random.default_rng(0)
    columns["time_ns"] = np.sort(rng.integers(0, 900, 5000)) * 10**9
    tables.write_table(tmp_path / "t.parquet", "residuals", columns)
    at_ns = np.array([7, 450, 451, 899, 10_000]) * 10**9
    found = tables.read_table(tmp_path / "t.parquet", "residuals", ["corner", "camera", "weight"], at_ns)
    wanted = np.isin(columns["time_ns"], at_ns)
    assert sorted(found) == ["camera", "corner", "weight"] and 10 < wanted.sum() < 50
    for name, values in found.items():
        np.testing.assert_array_equal(values, columns[name][wanted])


def test_row_groups_of_other_times_are_not_read(tmp_path, monkeypatch):
    import pyarrow.parquet as pq

    monkeypatch.setattr(tables, "ROW_GROUP", 100)
    columns = random_columns("residuals", 5000)
    columns["time_ns"] = np.arange(5000) * 10**9
    tables.write_table(tmp_path / "t.parquet", "residuals", columns)
    read, real = [], pq.ParquetFile.read_row_group
    monkeypatch.setattr(
        pq.ParquetFile, "read_row_group", lambda self, i, **k: (read.append(i), real(self, i, **k))[1]
    )
    found = tables.read_table(tmp_path / "t.parquet", "residuals", ["corner"], np.array([250, 4900]) * 10**9)
    assert read == [2, 49] and len(found["corner"]) == 2


def test_instants_that_are_not_there_give_no_rows(tmp_path):
    columns = random_columns("residuals", 10)
    tables.write_table(tmp_path / "t.parquet", "residuals", columns)
    for at_ns in ([], [-5]):
        found = tables.read_table(tmp_path / "t.parquet", "residuals", None, np.array(at_ns, np.int64))
        assert {len(values) for values in found.values()} == {0} and len(found) == 10


@pytest.mark.parametrize(
    "change, error, said",
    [
        (lambda c: c.pop("z"), ValueError, r"missing columns \['z'\]"),
        (lambda c: c.update(extra=c["z"]), ValueError, r"unknown columns \['extra'\]"),
        (lambda c: c.update(e=c["e"][:-1]), ValueError, "differ in length"),
        (lambda c: c.update(e=c["e"][:, None]), ValueError, "one dimension"),
        (lambda c: c["e"].__setitem__(3, np.nan), ValueError, "column e: NaN in 1 of 9"),
        (lambda c: c["point"].__setitem__(3, None), ValueError, "column point: 1 of 9 rows are null"),
        (lambda c: c.update(e=c["point"]), TypeError, "column e: expected float64"),
        (
            lambda c: c.update(e=c["e"].astype(complex)),
            TypeError,
            "column e: expected float64, found complex128",
        ),
    ],
)
def test_columns_that_break_the_schema_are_refused(tmp_path, change, error, said):
    columns = random_columns("checks", 9)
    change(columns)
    with pytest.raises(error, match=said):
        tables.write_table(tmp_path / "t.parquet", "checks", columns)
    assert not list(tmp_path.iterdir())


def test_whole_numbers_are_never_rounded_into_their_columns(tmp_path):
    columns = random_columns("frames", 3)
    with pytest.raises(TypeError, match="column time_ns: expected int64, found float64"):
        tables.write_table(tmp_path / "t", "frames", {**columns, "time_ns": columns["time_ns"] * 1.0})
    with pytest.raises(ValueError, match="column frame: does not fit into int32"):
        tables.write_table(tmp_path / "t", "frames", {**columns, "frame": np.array([0, 1, 2**31])})


def test_lists_are_taken_as_they_are(tmp_path):
    columns = random_columns("as_built", 2)
    columns |= {
        "h": [1.5, None],
        "lowest_time_ns": [None, 7],
        "state": ["cut", "passed over"],
        "passes": [1, 0],
    }
    tables.write_table(tmp_path / "t", "as_built", columns)
    found = tables.read_table(tmp_path / "t", "as_built")
    np.testing.assert_array_equal(found["h"], [1.5, np.nan])
    np.testing.assert_array_equal(found["lowest_time_ns"], [tables.NULL_INT, 7])


def test_missing_file_is_told(tmp_path):
    with pytest.raises(ArtefactError, match=r"t\.parquet is missing; run 'gradetrace report' again"):
        tables.read_table(tmp_path / "t.parquet", "checks")


def test_no_single_flipped_byte_comes_back_as_a_number(tmp_path):
    path = tmp_path / "t.parquet"
    columns = random_columns("checks", 200)
    tables.write_table(path, "checks", columns)
    whole = path.read_bytes()
    noticed, harmless = 0, 0
    for position in range(0, len(whole), max(1, len(whole) // 300)):
        damaged = bytearray(whole)
        damaged[position] ^= 0x55
        path.write_bytes(damaged)
        try:
            found = tables.read_table(path, "checks")
        except ArtefactError as error:
            assert str(path) in str(error)
            noticed += 1
        else:  # a byte of statistics or of a name that is not read
            for key, values in columns.items():
                np.testing.assert_array_equal(found[key], values, err_msg=f"{key}, byte {position}")
            harmless += 1
    assert noticed > harmless


@pytest.mark.parametrize("keep", [0, 3, 100, -100, -1])
def test_truncated_file_is_told(tmp_path, keep):
    path = tmp_path / "t.parquet"
    tables.write_table(path, "checks", random_columns("checks", 50))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ArtefactError, match=r"t\.parquet is damaged \("):
        tables.read_table(path, "checks")


def test_other_table_and_other_version_are_told(tmp_path, monkeypatch):
    path = tmp_path / "t.parquet"
    tables.write_table(path, "sensors", random_columns("sensors", 5))
    with pytest.raises(ArtefactError, match="holds sensors table, version 1; expected checks, version 2"):
        tables.read_table(path, "checks")
    schema = tables.read_schema("sensors")
    newer = tables.TableSchema(schema.name, 2, schema.meaning, schema.columns)
    monkeypatch.setattr(tables, "read_schema", lambda name: newer)
    with pytest.raises(ArtefactError, match="version 1; expected sensors, version 2"):
        tables.read_table(path, "sensors")


@pytest.fixture
def small_files_only():
    """A disk with room for 200 kB a file: writing more fails as it does on a full one."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_full_disk_is_one_sentence_and_leaves_the_old_file_whole(tmp_path, small_files_only):
    path = tmp_path / "poses.parquet"
    tables.write_table(path, "poses", random_columns("poses", 2))
    before = path.read_bytes()
    with pytest.raises(
        ArtefactError, match=r"^the disk is full: .*poses\.parquet could not be written; free"
    ):
        tables.write_table(path, "poses", random_columns("poses", 50_000))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["poses.parquet"]
