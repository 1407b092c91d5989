#!/usr/bin/env bash
# pcl_pcd2ply writes a PLY that nobody can read when the PCD's field rgb is a whole number.
#
# Seen with PCL 1.13.0 (Debian 12's pcl-tools). In a PCD the field rgb may be TYPE F (the bits of a float) or TYPE U; PCL
# and Open3D read both alike. PCL's writer of binary PLY announces `uchar red green blue` for either, but writes four bytes
# for the whole number: every vertex after the first is read from the wrong place.
#
# Output seen:
#   rgb F: 15 bytes a vertex announced, 15 written
#   rgb U: 15 bytes a vertex announced, 16 written
# Needs pcl-tools, or apt-get and root to fetch them into a temporary folder.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
tool=pcl_pcd2ply
if ! command -v $tool > /dev/null; then
  mkdir -p debs/partial root
  apt-get install -qq -y --no-install-recommends --download-only -o Dir::Cache::archives="$folder/debs" pcl-tools > /dev/null
  for package in debs/*.deb; do dpkg -x "$package" root; done
  tool=$folder/root/usr/bin/$tool
  lib=$folder/root/usr/lib
  export LD_LIBRARY_PATH=$lib/x86_64-linux-gnu:$lib:$lib/x86_64-linux-gnu/lapack:$lib/x86_64-linux-gnu/blas
fi
for type in F U; do
  cat > $type.pcd <<PCD
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F $type
COUNT 1 1 1 1
WIDTH 4
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 4
DATA ascii
0 0 1 660510
1 0 1 13112350
0 1 1 711710
1 1 1 660510
PCD
  "$tool" $type.pcd $type.ply > /dev/null 2>&1
done
python3 - <<'PYTHON'
from pathlib import Path

sizes = {}
for kind in "FU":
    header, body = Path(f"{kind}.ply").read_bytes().split(b"end_header\n", 1)
    vertex, camera = header.decode().split("element camera")[0], 19 * 4 + 2 * 4
    announced = 4 * vertex.count("property float") + vertex.count("property uchar")
    written = (len(body) - camera) / 4
    sizes[kind] = (announced, written)
    print(f"rgb {kind}: {announced} bytes a vertex announced, {written:g} written")
assert sizes == {"F": (15, 15), "U": (15, 16)}, sizes
PYTHON
