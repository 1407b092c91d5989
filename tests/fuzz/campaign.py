"""Fuzzes parsers with atheris (``pip install atheris``), guided by what their code does with each
input.

``python tests/fuzz/campaign.py WORK PARSER… [--minutes 10]`` works in the folder WORK:
``WORK/PARSER/found`` gets one input and its traceback a find, ``WORK/PARSER/corpus`` all inputs
that reached something new. ``--keep`` copies some of those to the corpus beside this file."""

import argparse
import hashlib
import json
import subprocess
import sys
import time
import traceback
import warnings
from pathlib import Path

HERE = Path(__file__).parent
LARGEST_BYTES, KEPT_BYTES, KEPT_FILES = 8192, 3000, 15
MEMORY_MB, TIMEOUT_S = 2000, 20


def fuzz(name: str, work: Path, options: list[str]) -> None:
    """Run atheris on one parser; returns never."""
    import atheris

    with atheris.instrument_imports(
        include=["stereo_ore", "yaml", "rosbags", "configparser", "json"]
    ):
        sys.path.insert(0, str(HERE))
        from parsers import PARSERS

    parser, folder, found = PARSERS[name], work / "files", work / "found"
    folder.mkdir(exist_ok=True)
    found.mkdir(exist_ok=True)
    warnings.simplefilter("error")

    def one(data: bytes) -> None:
        try:
            parser(data, folder)
        except Exception as fault:
            frames = traceback.extract_tb(fault.__traceback__)
            place = [frame for frame in frames if "stereo_ore" in frame.filename] or frames
            where = f"{type(fault).__name__}-{Path(place[-1].filename).stem}-{place[-1].lineno}"
            if not (found / where).exists():
                (found / where).write_bytes(data)
                (found / f"{where}.txt").write_text(traceback.format_exc())

    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


def campaign(name: str, work: Path, minutes: float) -> dict[str, object]:
    """Fuzz one parser in a process of its own for some minutes; what came of it."""
    work.mkdir(parents=True, exist_ok=True)
    (work / "corpus").mkdir(exist_ok=True)
    options = [
        str(work / "corpus"),
        str(HERE / "corpus" / name),
        f"-max_total_time={round(60 * minutes)}",
    ]
    options += [
        f"-rss_limit_mb={MEMORY_MB}",
        f"-timeout={TIMEOUT_S}",
        f"-artifact_prefix={work}/crash-",
    ]
    options += [f"-max_len={LARGEST_BYTES}", "-print_final_stats=1"]
    start = time.monotonic()
    with (work / "log").open("wb") as log:
        code = subprocess.call(
            [sys.executable, __file__, "--one", name, str(work), *options], stdout=log, stderr=log
        )
    stats = dict(
        line.removeprefix("stat::").split(":", 1)
        for line in (work / "log").read_text(errors="replace").splitlines()
        if line.startswith("stat::")
    )
    finds = sorted(file.stem for file in (work / "found").glob("*.txt"))
    finds += sorted(file.name for file in work.glob("crash-*"))
    executed = int(stats.get("number_of_executed_units", 0))
    minutes_run = round((time.monotonic() - start) / 60, 1)
    return {
        "parser": name,
        "minutes": minutes_run,
        "executed": executed,
        "exit": code,
        "finds": finds,
    }


def keep(name: str, work: Path) -> None:
    """Copy to the corpus beside this file some inputs that reached something new, from the smallest
    to the largest."""
    found = sorted((work / "corpus").iterdir(), key=lambda file: (file.stat().st_size, file.name))
    found = [file for file in found if file.stat().st_size <= KEPT_BYTES]
    for file in found[:: -(-len(found) // KEPT_FILES) or 1]:
        data = file.read_bytes()
        (HERE / "corpus" / name / hashlib.sha1(data).hexdigest()[:12]).write_bytes(data)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("parsers", nargs="+")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--keep", action="store_true")
    arguments = parser.parse_args()
    for name in arguments.parsers:
        work = arguments.work / name
        if arguments.keep:
            keep(name, work)
        else:
            sys.stdout.write(json.dumps(campaign(name, work, arguments.minutes)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        fuzz(sys.argv[2], Path(sys.argv[3]), sys.argv[4:])
    else:
        main()
