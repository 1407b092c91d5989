#!/usr/bin/env bash
# pandas 3.1.1 with pyarrow 26.0.1: a folder of Parquet files whose Hive partition is null can't be read by pandas.
#
# `date=__HIVE_DEFAULT_PARTITION__` is Hive's, Spark's and pyarrow's own name for null; pyarrow writes it itself. Seen:
# pandas.read_parquet raises when it is the only partition ("No non-null segments were available for field 'date'")
# and beside another ("Cannot yet unify dictionaries with nulls"). polars and DuckDB read both, pyarrow.dataset when it
# is told the type of the partition.
# A column in the files, and folders whose names are no key=value, is read by all four as one table.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q pandas==3.1.1 pyarrow==26.0.1 polars==2.1.0 duckdb==2.0.1
"$work/venv/bin/python" - "$work" <<'PY'
import sys
from datetime import date
from pathlib import Path

import duckdb
import pandas
import polars
import pyarrow as pa
from pyarrow import dataset, parquet

work = Path(sys.argv[1])


def refused(folder: Path) -> str:
    try:
        pandas.read_parquet(folder)
    except Exception as fault:
        return f"{type(fault).__name__}: {fault}"
    raise SystemExit("pandas reads it: the behaviour has changed")


for name, dates in (("alone", [None]), ("beside", [None, date(2026, 11, 18)])):
    folder = work / name
    table = pa.table({"ore": list(range(len(dates))), "date": pa.array(dates, pa.date32())})
    partitioning = dataset.partitioning(pa.schema([("date", pa.date32())]), flavor="hive")
    dataset.write_dataset(table, folder, format="parquet", partitioning=partitioning)
    print(name, sorted(path.name for path in folder.iterdir()))
    print("  pandas:", refused(folder))
    print("  pyarrow:", dataset.dataset(folder, partitioning=partitioning).to_table().num_rows)
    print("  polars:", len(polars.read_parquet(folder)))
    print("  DuckDB:", duckdb.sql(f"SELECT count(*) FROM read_parquet('{folder}/**/*.parquet')").fetchall()[0][0])

folder = work / "column"
for name, day in (("undated", None), ("2026-11-18", date(2026, 11, 18))):
    (folder / name).mkdir(parents=True)
    parquet.write_table(pa.table({"ore": [1], "date": pa.array([day], pa.date32())}), folder / name / "a.parquet")
read = pandas.read_parquet(folder)
print("column, pandas:", read["date"].tolist())
assert sorted(map(str, read["date"])) == ["2026-11-18", "None"]
PY
