"""`serve --ros2` with a stub in place of the chain, for the tests of ROS 2.

``python ros2_server.py LEFT_TOPIC RIGHT_TOPIC OUT WORK_S`` works that long on each frame, until its
standard input ends; then it writes a line of JSON: pairs that had come when a frame was
published, its age, and the memory [kB] after each hundredth frame.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import live

from stereo_ore.plant.ros2.opening import open_topics
from stereo_ore.plant.ros2.source import Topics, Wanted

VALID_FOR_S = 60.0


def memory_kb() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0])


class Sink(live.ListSink):
    def __init__(self, source: Topics) -> None:
        super().__init__()
        self.source = source
        self.newer: list[int] = []
        self.ages_s: list[float] = []
        self.memory: list[int] = []
        self.count = 0

    def publish(self, message: Any) -> None:
        if message.frame is None:
            return
        self.count += 1
        self.newer.append(self.source.pairs_waiting)
        self.ages_s.append(VALID_FOR_S - (message.deadline - time.monotonic()))
        if self.count % 100 == 0:
            self.memory.append(memory_kb())


def main() -> None:
    left, right, out, work_s = sys.argv[1:]
    source = open_topics(Wanted((left, right)))
    sink = Sink(source)
    quick = live.lines_of

    def slow(frame: Any, **record: Any) -> Any:
        if not frame.superseded:
            time.sleep(float(work_s))
        return quick(frame, **record)

    live.lines_of = slow
    with live.running(source, Path(out), [sink], VALID_FOR_S):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()
    about = {"newer": sink.newer, "ages_s": sink.ages_s, "memory_kb": sink.memory}
    sys.stdout.write(json.dumps(about | {"state": source.state()}) + "\n")


if __name__ == "__main__":
    main()
