"""Faults of the images planted in a recording of the real command: one run, a frame a fault, sound
frames between."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import ROOT, smaller_scene

from stereo_ore.plant.sinks.message import Origin, message
from stereo_ore.types import U8

Eyes = tuple[U8, U8]
SOUND_FIRST = 6
"""Sound frames before the first fault: what is usual is known then."""


def sensor(image: U8, seed: int) -> U8:
    """The image as a sensor gives it once more: with other noise."""
    noise = np.random.default_rng(seed).normal(0, 0.7, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def muddy(image: U8) -> U8:
    """A third of the lens under a blob with soft edges."""
    height, width = image.shape[:2]
    blob = cv2.circle(
        np.zeros((height, width), np.float32),
        (width // 2, height // 2),
        int(0.45 * height),
        1.0,
        -1,
    )
    blob = cv2.GaussianBlur(blob, (0, 0), 6)[..., None]
    return np.rint(image * (1 - blob) + np.float32([25, 35, 45]) * blob).astype(np.uint8)


def other_moment(right: U8) -> U8:
    other = cv2.imread(str(ROOT / "data" / "large_02" / "right.png"))
    return np.asarray(cv2.resize(other, right.shape[1::-1]), np.uint8)


def slipped(right: U8) -> U8:
    """A fifth of the rows comes eight columns late."""
    out, height = right.copy(), len(right)
    out[2 * height // 5 : 3 * height // 5] = np.roll(
        right[2 * height // 5 : 3 * height // 5], -8, axis=1
    )
    return out


def warped(image: U8, du: np.ndarray, dv: np.ndarray | float = 0.0) -> U8:
    v, u = np.indices(image.shape[:2])
    columns, rows = np.asarray(u + du, np.float32), np.asarray(v + dv, np.float32)
    return np.asarray(
        cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def wobbling(image: U8) -> U8:
    """Rows swing along themselves by two pixels, four times from top to bottom."""
    height = len(image)
    return warped(image, 2 * np.sin(2 * np.pi * 4 * np.arange(height) / height)[:, None])


def under_a_drop(image: U8) -> U8:
    """A drop in the middle magnifies what lies behind it by a tenth."""
    v, u = np.indices(image.shape[:2]) - np.array(image.shape[:2]).reshape(2, 1, 1) / 2
    gain = -0.1 * np.clip(1 - (u**2 + v**2) / (0.35 * len(image)) ** 2, 0, 1)
    return warped(image, gain * u, gain * v)


def both(change: Callable[[U8], U8]) -> Callable[[U8, U8], Eyes]:
    return lambda left, right: (change(left), change(right))


FAULTS: dict[str, tuple[Callable[[U8, U8], Eyes], str, str]] = {
    "swapped": (lambda left, right: (right, left), "degraded", "EYES_DISAGREE"),
    "black1": (lambda left, right: (0 * left, right), "failed", "FEW_DISPARITIES"),
    "black2": (lambda left, right: (left, 0 * right), "failed", "FEW_DISPARITIES"),
    "covered2": (lambda left, right: (left, sensor(0 * right + 90, 1)), "degraded|failed",
        "EYES_DISAGREE"),
    "other_moment": (lambda left, right: (left, other_moment(right)), "degraded|failed",
        "EYES_DISAGREE"),
    "columns_shifted": (lambda left, right: (left, np.roll(right, 12, 1)), "degraded",
        "SCREEN_MOVED"),
    "rows_shifted": (lambda left, right: (left, np.roll(right, 1, 0)), "degraded", "ROWS_DISAGREE"),
    "upside_down": (lambda left, right: (left, right[::-1, ::-1]), "degraded|failed",
        "EYES_DISAGREE"),
    "saturated": (both(lambda x: np.clip(20.0 * x, 0, 255).astype(np.uint8)), "degraded|failed",
        "FEW_DISPARITIES"),
    "dark": (both(lambda x: sensor(np.uint8(0.03 * x), 2)), "degraded|failed", "TOO_DARK"),
    "out_of_focus": (both(lambda x: sensor(cv2.GaussianBlur(x, (0, 0), 6), 3)), "degraded",
        "OUT_OF_FOCUS"),
    "mud1": (lambda left, right: (muddy(left), right), "degraded", "VALID_SHARE_FELL"),
    "mud2": (lambda left, right: (left, muddy(right)), "degraded", "VALID_SHARE_FELL"),
    "slipped_rows": (lambda left, right: (left, slipped(right)), "degraded", "PARTS_DISAGREE"),
    "wobbling_rows": (lambda left, right: (left, wobbling(right)), "degraded", "PARTS_DISAGREE"),
    "drop": (lambda left, right: (left, under_a_drop(right)), "degraded", "PARTS_DISAGREE"),
    "half_size": (both(lambda x: x[::2, ::2]), "failed", "SIZE_MISMATCH"),
}  # fmt: skip
BYTES = {"empty": b"", "no_image": b"no image at all"}


def write(folder: Path, name: str, eyes: Eyes) -> None:
    for eye, image in zip(("left", "right"), eyes, strict=True):
        (folder / eye).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / eye / f"{name}.png"), np.ascontiguousarray(image))


def plant(folder: Path, left: U8, right: U8) -> None:
    """Sound frames, then the faults, with sound frames between, in the order of their names."""
    frames: list[tuple[str, Eyes | None]] = [("sound", None)] * SOUND_FIRST
    for number, (name, (fault, _, _)) in enumerate(FAULTS.items()):
        frames.append(
            (name, fault(sensor(left, 500 + 2 * number), sensor(right, 501 + 2 * number)))
        )
        frames += [("sound", None)] * (number % 3 == 2)
    frames.append(("sound", None))
    for number, (name, eyes) in enumerate(frames):
        write(
            folder,
            f"{number:03d}_{name}",
            eyes or (sensor(left, 2 * number), sensor(right, 2 * number + 1)),
        )
    last = f"{len(frames) - 1:03d}_sound"
    same = [(folder / eye / f"{last}.png").read_bytes() for eye in ("left", "right")]
    for name, sides in (("frozen", "left right"), ("frozen1", "left")):
        write(folder, f"{len(frames)}_{name}", (left, right))
        for eye, data in zip(("left", "right"), same, strict=True):
            if eye in sides:
                (folder / eye / f"{len(frames)}_{name}.png").write_bytes(data)
    for name, data in {**BYTES, "truncated": same[0][: len(same[0]) // 2]}.items():
        write(folder, f"9{len(frames)}_{name}", (left, right))
        (folder / "left" / f"9{len(frames)}_{name}.png").write_bytes(data)
    write(folder, "999_sound", (sensor(left, 991), sensor(right, 992)))


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """The last record of each fault, by its name; of "sound" all are in a list under "all"."""
    scene, folder = (
        tmp_path_factory.mktemp("scene"),
        tmp_path_factory.mktemp("faults") / "recording",
    )
    folder.mkdir()
    arguments = smaller_scene(scene, 2)
    plant(
        folder,
        *(np.asarray(cv2.imread(str(scene / f"{eye}.png")), np.uint8) for eye in ("left", "right")),
    )
    command = [
        "stereo-ore",
        "run",
        str(folder),
        *arguments,
        "--out",
        str(folder.parent / "out"),
        "--no-report",
    ]
    done = subprocess.run([*command, "--workers", "2"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    lines = [
        json.loads(line)
        for line in (folder.parent / "out" / "frames.jsonl").read_text().splitlines()
    ]
    return {line["frame"].partition("_")[2]: line for line in lines} | {"all": lines}


def codes(record: dict) -> list[str]:
    return [reason["code"] for reason in record["reasons"]]


def arm_sees_nothing(record: dict) -> bool:
    sent = message(record, 1, Origin(), age_s=0.0, valid_for_s=60.0)
    return not sent.valid and sent.targets == ()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_images_is_told_and_gives_no_target(
    fault: str, records: dict[str, dict]
) -> None:
    _, statuses, code = FAULTS[fault]
    record = records[fault]
    assert record["status"] in statuses.split("|"), codes(record)
    assert code in codes(record)
    assert record["targets"] == []
    assert arm_sees_nothing(record)


@pytest.mark.parametrize("fault", ["frozen", "frozen1"])
def test_a_frozen_image_is_told_and_gives_no_target(fault: str, records: dict[str, dict]) -> None:
    assert records[fault]["status"] == "degraded"
    assert codes(records[fault]) == ["FRAME_FROZEN"]
    assert records[fault]["targets"] == []
    assert arm_sees_nothing(records[fault])


@pytest.mark.parametrize("fault", ["empty", "no_image", "truncated"])
def test_a_file_that_is_no_whole_image_fails_alone(fault: str, records: dict[str, dict]) -> None:
    assert records[fault]["status"] == "failed"
    assert arm_sees_nothing(records[fault])


def test_sound_frames_between_faults_keep_their_targets(records: dict[str, dict]) -> None:
    sound = [record for record in records["all"] if record["frame"].endswith("sound")]
    assert len(sound) == SOUND_FIRST + len(FAULTS) // 3 + 2
    assert [(record["frame"], codes(record)) for record in sound if record["status"] != "ok"] == []
    assert all(record["targets"] and not arm_sees_nothing(record) for record in sound)
