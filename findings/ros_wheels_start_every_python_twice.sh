#!/usr/bin/env bash
# ros-wheels-bootstrapper 0.1.2 (Python 3.11; every ros-jazzy-* wheel of the registry depends on it): installed, it starts
# every Python of its environment a second time, and puts folders of libraries in front of the user's in any order.
#
# A .pth file imports it before anything else; it calls execve with a LD_LIBRARY_PATH that it has joined from a Python set.
# Seen: (1) also `python -c pass` runs twice; (2) the folder of the environment stands before the user's own in some runs
# and behind it in others, so that of a sourced ROS 2, whose libraries have the same names, sometimes the wheels' are
# loaded; (3) a Python that inherits the mark "done" from another environment gets no libraries at all.
# Wanted: the user's LD_LIBRARY_PATH first, in its order.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q ros-wheels-bootstrapper==0.1.2
python="$work/venv/bin/python"
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH

cat > "$work/venv/lib/$(ls "$work/venv/lib")/site-packages/a_first.pth" <<PTH
import os; os.write(2, b"started\n")
PTH
once=$(_ROS_WHEELS_BOOTSTRAP_COMPLETE=1 "$python" -c pass 2>&1 | grep -c started)
starts=$("$python" -c pass 2>&1 | grep -c started)
echo "lines of one start: $once, of one python: $starts"
test "$starts" -gt "$once"

first=0
for seed in $(seq 16); do
    path=$(LD_LIBRARY_PATH=/opt/ros/jazzy/lib PYTHONHASHSEED=$seed "$python" -c 'import os; print(os.environ["LD_LIBRARY_PATH"])' 2>/dev/null)
    case "$path" in /opt/ros/*) first=$((first + 1)) ;; esac
done
echo "the user's folder was first in $first of 16 runs"
test "$first" -gt 0
test "$first" -lt 16

path=$(_ROS_WHEELS_BOOTSTRAP_COMPLETE=1 "$python" -c 'import os; print(os.environ.get("LD_LIBRARY_PATH", "none"))' 2>/dev/null)
echo "with the mark inherited: $path"
test "$path" = none
