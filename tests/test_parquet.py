"""Runs as Parquet tables, asked by DuckDB and pyarrow as an analyst would."""

import json
import shutil
import subprocess
import sys
from datetime import date
from pathlib import Path

import pytest
from runs import STAMP, make_run, of_today, ore, record

from stereo_ore.errors import OutputError, SourceError
from stereo_ore.io.ore_table import FIELDS
from stereo_ore.io.results import Results

pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
pytest.importorskip("duckdb", reason="duckdb is not installed")

import duckdb
import pyarrow as pa
from pyarrow import dataset, parquet

from stereo_ore.export.parquet import NO_DAY, TABLES, run_id, schema_of, write_parquet

DAY_NS = 86_400_000_000_000
GUIDE = Path(__file__).parents[1] / "docs" / "cluster.md"


def add(
    folder: Path, records: list[dict], lake: Path, digest: str, camera: str | None = None
) -> Path:
    """A run with these records, added to `lake`."""
    make_run(folder, records, stages=False)
    (folder / "run.json").write_text(
        json.dumps({"digest": digest, "inputs": [{"frame": records[0]["frame"]}]})
    )
    return write_parquet(Results(folder), lake, camera)


def ask(query: str) -> list[tuple]:
    return duckdb.sql(query).fetchall()


def files(lake: Path) -> list[Path]:
    return sorted(path for path in lake.rglob("*") if path.is_file())


@pytest.fixture
def lake(tmp_path: Path) -> Path:
    """Two runs of different cameras; the first goes on for a day and has a frame without ores."""
    first = [record(0, [ore(1), ore(2, oversize=False)]), record(1, [ore(1, strike=False)])]
    first += [
        of_today(record(2, [ore(1)], stamp_ns=STAMP + DAY_NS), "header"),
        record(3, [], "empty", stamp_ns=STAMP + 2 * DAY_NS),
    ]
    add(tmp_path / "a", first, tmp_path / "lake", "a", "north")
    return add(tmp_path / "b", [record(0, [ore(7)])], tmp_path / "lake", "b", "south")


def test_rows_are_the_ores_of_the_records(lake: Path) -> None:
    rows = ask(
        f"""SELECT camera, frame, id, target_rank, oversize, cog_arm_z_m, volume_low_m3,
                   reasons, strike_score, stamp_source
                   FROM read_parquet('{lake}/ores/**/*.parquet') ORDER BY camera, index, id"""
    )
    assert rows == [
        ("north", "000000", 1, 2, True, 3.0, 0.003, [], 0.9, None),
        ("north", "000000", 2, 1, False, 3.0, 0.003, [], 0.9, None),
        ("north", "000001", 1, None, True, 3.0, 0.003, ["TOO_STEEP"], None, None),
        ("north", "000002", 1, 1, True, 3.0, 0.003, [], 0.9, "header"),
        ("south", "000000", 7, 1, True, 3.0, 0.003, [], 0.9, None),
    ]


def test_days_are_folders_and_a_column_and_stamps_are_exact(lake: Path) -> None:
    days = ask(f"""SELECT CAST(date AS VARCHAR), count(*), min(epoch_ns(stamp_utc))
                   FROM read_parquet('{lake}/frames/**/*.parquet') GROUP BY 1 ORDER BY 1""")
    assert days == [
        ("2023-11-14", 3, STAMP),
        ("2023-11-15", 1, STAMP + DAY_NS),
        ("2023-11-16", 1, STAMP + 2 * DAY_NS),
    ]
    table = dataset.dataset(lake / "ores")
    assert table.count_rows(filter=dataset.field("date") == date(2023, 11, 15)) == 1
    assert table.count_rows(filter=dataset.field("date") == date(2023, 11, 16)) == 0
    assert {path.parent.name for path in lake.glob("ores/*/*")} == {
        "2023-11-14",
        "2023-11-15",
        "2023-11-16",
    }


@pytest.mark.parametrize("name", TABLES)
def test_types_and_units_are_the_same_in_every_file(lake: Path, name: str) -> None:
    schemas = [parquet.read_schema(path) for path in (lake / name).rglob("*.parquet")]
    assert len(schemas) == 4
    for schema in schemas:
        assert schema.equals(schema_of(name))
        assert schema.metadata[b"schema"] == b"stereo_ore/parquet/2"
    units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schemas[0]}
    expected = {
        "ores": {
            "cog_arm_x_m": "m",
            "volume_m3": "m³",
            "slope_deg": "degree",
            "direction_arm_x": "",
        }
    }
    for column, unit in expected.get(name, {"grizzly_offset_m": "m"}).items():
        assert units[column] == unit
    assert not pa.types.is_null(schemas[0].field("index").type)


def test_columns_hold_those_of_the_table_of_a_run() -> None:
    assert set(FIELDS) <= set(TABLES["ores"])


def test_a_run_added_again_takes_its_own_place(lake: Path, tmp_path: Path) -> None:
    before = files(lake)
    grown = [record(0, [ore(1)]), record(1, [ore(1), ore(2)]), record(2, [ore(1)])]
    shutil.rmtree(tmp_path / "a")
    add(tmp_path / "a", grown, lake, "a", "north")
    assert ask(
        f"SELECT camera, count(*) FROM '{lake}/ores/**/*.parquet' GROUP BY 1 ORDER BY 1"
    ) == [
        ("north", 4),
        ("south", 1),
    ]
    assert len(files(lake)) == len(before) - 4


def test_a_running_run_has_the_name_of_the_finished_one(tmp_path: Path) -> None:
    entry = {"frame": "000000", "files": {"a.png": "12"}}
    for name, inputs in (
        ("done", [entry, entry]),
        ("running", None),
        ("other", [{"frame": "000000", "files": {}}]),
    ):
        (tmp_path / name).mkdir()
        run = {"digest": "d"} if inputs is None else {"digest": "d", "inputs": inputs}
        (tmp_path / name / "run.json").write_text(json.dumps(run))
    (tmp_path / "running" / "inputs.jsonl.part").write_text(json.dumps(entry) + "\n")
    done, running, other = (
        run_id(Results(tmp_path / name)) for name in ("done", "running", "other")
    )
    assert done == running != other


def test_frames_without_a_stamp_have_no_day(tmp_path: Path) -> None:
    add(tmp_path / "a", [record(0, [ore(1)], stamp_ns=None)], tmp_path / "lake", "a")
    add(tmp_path / "b", [record(0, [ore(1)])], tmp_path / "lake", "b")
    assert (tmp_path / "lake" / "ores" / NO_DAY).is_dir()
    query = (
        "SELECT CAST(date AS VARCHAR), stamp_utc IS NULL, camera FROM"
        f" '{tmp_path}/lake/ores/**/*.parquet' ORDER BY 2"
    )
    camera = Results(tmp_path / "a").camera
    assert ask(query) == [("2023-11-14", False, camera), (None, True, camera)]


def with_pandas(folder: Path) -> list[tuple]:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    table = pandas.read_parquet(folder)
    return [(row.frame, row.date, row.camera) for row in table.itertuples()]


def with_polars(folder: Path) -> list[tuple]:
    polars = pytest.importorskip("polars", reason="polars is not installed")
    return polars.read_parquet(folder).select("frame", "date", "camera").rows()


def with_pyarrow(folder: Path) -> list[tuple]:
    table = parquet.read_table(folder).select(["frame", "date", "camera"])
    return [tuple(row.values()) for row in table.to_pylist()]


def with_duckdb(folder: Path) -> list[tuple]:
    return ask(f"SELECT frame, date, camera FROM read_parquet('{folder}/**/*.parquet')")


@pytest.mark.parametrize("read", [with_pandas, with_polars, with_pyarrow, with_duckdb])
@pytest.mark.parametrize(
    "stamps", [(None,), (STAMP,), (None, STAMP), (None, STAMP, STAMP + DAY_NS)]
)
def test_every_reader_takes_the_folder_as_one_table(tmp_path: Path, read, stamps) -> None:
    """Runs with and without stamps, and a run whose frames have one now and then."""
    for number, stamp in enumerate(stamps):
        records = [record(0, [ore(1)], stamp_ns=stamp), record(1, [ore(1), ore(2)], stamp_ns=stamp)]
        add(tmp_path / str(number), records, tmp_path / "lake", str(number), str(number))
    mixed = [record(0, [ore(1)], stamp_ns=None), record(1, [ore(1)], stamp_ns=STAMP)]
    add(tmp_path / "mixed", mixed, tmp_path / "lake", "mixed", "mixed")
    days = {None: None, STAMP: date(2023, 11, 14), STAMP + DAY_NS: date(2023, 11, 15)}
    expected = [("000000", None, "mixed"), ("000001", days[STAMP], "mixed")]
    for number, stamp in enumerate(stamps):
        expected += [(name, days[stamp], str(number)) for name in ("000000", "000001", "000001")]
    assert sorted(map(str, read(tmp_path / "lake" / "ores"))) == sorted(map(str, expected))
    assert len(read(tmp_path / "lake" / "frames")) == 2 + 2 * len(stamps)


def test_tables_of_an_earlier_version_are_not_mixed_with_new_ones(tmp_path: Path) -> None:
    (tmp_path / "lake" / "frames" / "date=2023-11-14").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"date=2023-11-14: is of an earlier version.*new folder"):
        add(tmp_path / "a", [record(0, [ore(1)])], tmp_path / "lake", "a")


def test_a_fault_leaves_the_tables_as_they_were(lake: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in files(lake)}
    shutil.rmtree(tmp_path / "a")
    broken = [record(0, [ore(1)]), record(1, [ore(1) | {"volume_m3": "much"}])]
    with pytest.raises(SourceError, match=r"line 2 is no record: ores\.0\.volume_m3"):
        add(tmp_path / "a", broken, lake, "a", "north")
    assert {path: path.read_bytes() for path in files(lake)} == before
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="can't be written"):
        write_parquet(Results(tmp_path / "b"), tmp_path / "file")
    with pytest.raises(SourceError, match=r"holds no frames\.jsonl"):
        write_parquet(Results(tmp_path), tmp_path / "other")


def test_the_query_of_the_readme(lake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    query = GUIDE.read_text(encoding="utf-8").partition("```sql\n")[2].partition("```")[0]
    monkeypatch.chdir(lake.parent)
    lake.rename(lake.parent / "tables")
    rows = ask(query)
    assert [(str(month), camera) for month, camera, *_ in rows] == [
        ("2023-11-01", "north"),
        ("2023-11-01", "south"),
    ]
    assert rows[0][2:4] == (3, 2)


def test_command_and_missing_extra(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", stages=False)
    command = [
        "stereo-ore",
        "export",
        run,
        tmp_path / "tables",
        "--format",
        "parquet",
        "--camera",
        "east",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip()) == (0, str(tmp_path / "tables"))
    assert ask(f"SELECT DISTINCT camera FROM '{tmp_path}/tables/ores/**/*.parquet'") == [("east",)]
    words = ["export", str(run), str(tmp_path / "x"), "--format", "parquet"]
    code = (
        "import sys; sys.modules['pyarrow'] = None\nfrom stereo_ore.cli import launch;"
        f" launch({words!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert (
        done.stderr == "error: the optional package pyarrow is not installed. pip install"
        ' "stereo-ore[parquet]"\n'
    )
