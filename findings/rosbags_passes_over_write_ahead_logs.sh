#!/usr/bin/env bash
# rosbags passes over the write-ahead log beside a ROS 2 database without a word.
#
# Seen with rosbags 0.11.9. rosbag2's crash-proof preset records with SQLite's write-ahead log. A recording that
# was copied while it ran, or whose recorder was killed, is a .db3 and a .db3-wal; every SQLite client reads both
# as one. rosbags opens the .db3 as immutable: of 12 messages it gives the 4 that had been checkpointed, with no
# error and no warning.
#
# Output seen:
#   SQLite: 12 messages, rosbags: 4 messages
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet rosbags==0.11.9
cat > log.py <<'PYTHON'
import shutil
import sqlite3
from pathlib import Path

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
String = store.types["std_msgs/msg/String"]
with Writer(Path("bag"), version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
    connection = bag.add_connection("/chatter", String.__msgtype__, typestore=store)
    for number in range(12):
        bag.write(connection, number, store.serialize_cdr(String(str(number)), String.__msgtype__))
(whole,) = Path("bag").glob("*.db3")

Path("live").mkdir()
lines = [line for line in sqlite3.connect(whole).iterdump() if line not in ("BEGIN TRANSACTION;", "COMMIT;")]
rows = [line for line in lines if 'INTO "messages"' in line]
live = sqlite3.connect("live/bag.db3")
live.executescript("\n".join(line for line in lines if line not in rows))
live.execute("pragma journal_mode=wal")
for number, row in enumerate(rows, 1):
    live.execute(row)
    live.commit()
    if number == 4:
        live.execute("pragma wal_checkpoint(truncate)")
shutil.copytree("live", "copy")  # as it is while the recorder runs

with Reader(Path("copy/bag.db3")) as reader:
    seen = sum(1 for _ in reader.messages())
(there,) = sqlite3.connect("copy/bag.db3").execute("select count(*) from messages").fetchone()
print(f"SQLite: {there} messages, rosbags: {seen} messages")
assert (there, seen) == (12, 4), (there, seen)
PYTHON
venv/bin/python log.py
