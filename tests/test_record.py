"""The record: valid against the schema whatever is missing, never a NaN, both frames right."""

import json
from dataclasses import replace
from importlib.resources import files

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereo_ore.chain import COUNTS
from stereo_ore.record import number, record, to_line
from stereo_ore.types import (
    FrameResult,
    Grizzly,
    Ore,
    Plane,
    Reason,
    Site,
    Solid,
    Strike,
    StrikePlan,
)

SCHEMA = json.loads((files("stereo_ore") / "schema" / "frame-2.json").read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

T_ARM_CAMERA = np.array([[0.0, 1, 0, 1], [1, 0, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])
FAILED = FrameResult(
    "000007", 7, None, "failed", (Reason("UNPAIRED", "no right image"),), dict.fromkeys(COUNTS, 0)
)

coordinates = st.floats(-50, 50)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
positive = st.floats(0, 10)

strikes = st.builds(
    Strike,
    point=vectors,
    direction=st.just(np.array([0.0, 0.6, 0.8])),
    slope_rad=st.floats(0, 1.5),
    flatness_m=positive,
    score=st.floats(0, 1),
)
solids = st.builds(
    Solid,
    centre_of_gravity=vectors,
    sigma_m=st.tuples(positive, positive, positive).map(np.array),
    volume_m3=positive,
    volume_bounds_m3=st.tuples(positive, positive),
    box_centre=vectors,
    axes=st.just(np.eye(3)),
    extent_m=st.just(np.array([0.3, 0.2, 0.1])),
    size_m=st.just(np.array([0.3, 0.2, 0.1])),
    method=st.just("hull"),
    vertices=st.just(np.zeros((0, 3), np.float32)),
    oversize=st.sampled_from([True, False, None]),
)
ores = st.builds(
    Ore,
    id=st.integers(1, 99),
    points=st.integers(0, 9),
    pixels=st.integers(1, 9),
    cut=st.booleans(),
    surface_centroid=vectors,
    solid=st.none() | solids,
    plan=st.builds(
        StrikePlan,
        strikes=st.lists(strikes, max_size=3).map(tuple),
        reasons=st.just((Reason("TOO_STEEP", "62°"),)),
    ),
)
results = st.builds(
    FrameResult,
    name=st.text(min_size=1, max_size=9),
    index=st.integers(0, 10**6),
    stamp_ns=st.none() | st.integers(0, 2**63),
    status=st.sampled_from(["ok", "degraded", "empty", "failed"]),
    reasons=st.just(()),
    counts=st.just(dict.fromkeys(COUNTS, 3)),
    grizzly=st.none() | st.just(Grizzly(Plane(np.array([0.0, 0, -1]), -2.0), "auto", 0.004)),
    ores=st.lists(ores, max_size=3).map(tuple),
    targets=st.just((1,)),
)


@given(results, st.booleans())
@settings(deadline=None, max_examples=60)
def test_every_record_is_valid_and_survives_json(result: FrameResult, arm: bool) -> None:
    T = T_ARM_CAMERA if arm else None
    result = replace(result, ores=tuple(ore.located(T) for ore in result.ores))
    data = record(result, Site(T_arm_camera=T))
    VALIDATOR.validate(data)
    assert json.loads(to_line(data)) == data


def test_the_schema_refuses_what_is_no_record() -> None:
    data = record(FAILED, Site())
    for broken in (
        data | {"units": "mm"},
        data | {"extra": 1},
        {key: data[key] for key in data if key != "status"},
    ):
        with pytest.raises(jsonschema.ValidationError):
            VALIDATOR.validate(broken)


def test_a_failed_frame_says_why_and_targets_nothing() -> None:
    data = record(FAILED, Site())
    assert data["reasons"] == [{"code": "UNPAIRED", "detail": "no right image"}]
    assert (data["ores"], data["targets"], data["grizzly"]) == ([], [], None)


def test_points_are_moved_and_directions_only_turned() -> None:
    strike = Strike(np.array([1.0, 2, 3]), np.array([0.0, 0, 1]), np.radians(8), 0.003, 0.9)
    ore = Ore(
        1,
        5,
        9,
        False,
        np.array([0.5, 0, 2]),
        None,
        StrikePlan((strike, replace(strike, score=0.4))),
    )
    site = Site(T_arm_camera=T_ARM_CAMERA)
    data = record(replace(FAILED, status="ok", ores=(ore.located(T_ARM_CAMERA),)), site)["ores"][0]
    assert data["surface_centroid"] == {"camera": [0.5, 0, 2], "arm": [1, 2.5, 1]}
    assert data["strike"]["point"]["arm"] == [3, 3, 0]
    assert data["strike"]["direction"] == {"camera": [0, 0, 1], "arm": [0, 0, -1]}
    assert data["strike"]["slope_deg"] == 8
    assert [blow["score"] for blow in data["strike"]["alternates"]] == [0.4]
    assert data["centre_of_gravity"] is None


@pytest.mark.parametrize(
    ("value", "written"),
    [(np.nan, None), (np.inf, None), (-0.0000001, 0.0), (1 / 3, 0.333333), (np.float32(2), 2.0)],
)
def test_numbers_are_rounded_and_finite(value: float, written: float | None) -> None:
    assert number(value) == written
    assert str(number(value)) != "-0.0"
