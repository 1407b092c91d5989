"""Messages and their expiry: what an arm may believe, and for how long."""

import json
import threading
import time
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live import ListSink, make_message, make_ore, make_record, wait_for

from stereo_ore.errors import OutputError
from stereo_ore.plant.publisher import Publisher
from stereo_ore.plant.sinks.base import Outbox
from stereo_ore.plant.sinks.message import Origin, message, offline, transform_id
from stereo_ore.times import utc


def test_the_records_of_these_tests_are_real_ones():
    schema = json.loads((files("stereo_ore") / "schema" / "frame-1.json").read_text())
    for record in (make_record(3), make_record(4, status="degraded"), make_record(5, arm=False)):
        jsonschema.validate(record, schema)


def test_messages_are_what_their_schema_says():
    schema = json.loads((files("stereo_ore") / "schema" / "targets-1.json").read_text())
    sink = ListSink()
    with Publisher(
        [sink], valid_for_s=1.0, origin=Origin(transform_id="0123456789ab")
    ) as publisher:
        for index, changes in enumerate(
            ({}, {"status": "failed"}, {"arm": False}, {"ores": 0}, {"stamp_ns": 10**18})
        ):
            publisher.publish(make_record(index, **changes), age_s=0.0)
        wait_for(lambda: len(sink.messages) == 6, what="expiry")
    for _, made in sink.messages:
        jsonschema.validate(json.loads(made.line()), schema)
    gone = json.loads(offline(Origin("s", replay=True)))
    jsonschema.validate(gone, schema)
    assert (gone["session"], gone["replay"], gone["sequence"], gone["published_ns"]) == (
        "s",
        True,
        None,
        None,
    )
    wrong = json.loads(make_message().line()) | {"valid": False}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, schema)


def test_the_rule_of_the_guide_says_which_message_counts():
    """Withdrawals are never dropped, nor what a program says that is back; late ones are."""
    guide = (Path(__file__).parents[1] / "docs" / "plant.md").read_text(encoding="utf-8")
    names: dict = {}
    exec(guide.partition("```python\n")[2].partition("```")[0], names)
    first, second = (make_message(sequence).json() for sequence in (1, 2))
    gone = json.loads(offline(Origin("test")))
    anew = {**first, "session": "later", "sequence": 1}
    last, taken = None, []
    for sent in (first, second, first, gone, second, first, gone, anew):
        if names["counts"](sent, last):
            last = sent
            taken.append(sent)
    assert taken == [first, second, gone, second, gone, anew]


def test_a_message_carries_targets_in_order_with_unit_and_frame():
    ores = [make_ore(1), make_ore(2), make_ore(3)]
    record = make_record(4, ores=3, targets=[3, 1])
    record["ores"] = ores
    made = message(record, 7, Origin("s", "abc", True), age_s=0.0, valid_for_s=5.0)
    sent = json.loads(made.line())
    assert [target["id"] for target in sent["targets"]] == [3, 1]
    assert (sent["units"], sent["coordinates"], sent["sequence"], sent["frame"]) == (
        "m",
        "arm",
        7,
        "000004",
    )
    assert (sent["transform_id"], sent["replay"], sent["session"], sent["valid"]) == (
        "abc",
        True,
        "s",
        True,
    )
    assert sent["targets"][0]["position_m"] == ores[2]["strike"]["point"]["arm"]
    assert sent["valid_until_ns"] - sent["published_ns"] == pytest.approx(5e9, rel=0.01)


def test_a_target_has_its_rank_and_track_and_a_message_names_foreign_bodies():
    record = make_record(4, ores=3, targets=[3, 1])
    record["ores"][2]["track"] = {"number": 17, "frames": 4}
    record["foreign"] = [{"name": "boom"}]
    sent = message(record, 7, Origin(), age_s=0.0, valid_for_s=5.0).json()
    told = [(target["id"], target["rank"], target["track"]) for target in sent["targets"]]
    assert told == [(3, 1, 17), (1, 2, None)]
    assert sent["foreign"] == ("boom",)


def test_a_message_has_the_share_of_the_screen_that_is_under_fines():
    for screen, told in ((None, None), ({"normal": [0, 0, -1]}, None), ({"fines_share": 0.2}, 0.2)):
        record = make_record(4) | {"grizzly": screen}
        made = message(record, 7, Origin(), age_s=0.0, valid_for_s=5.0)
        assert made.json()["fines_share"] == told


@pytest.mark.parametrize("status", ["degraded", "failed", "empty"])
def test_only_ok_frames_have_targets(status):
    # Even a record that lists targets beside a bad status must not move an arm.
    made = message(
        make_record(status="ok") | {"status": status}, 1, Origin(), age_s=0.0, valid_for_s=5.0
    )
    assert not made.valid
    assert made.targets == ()
    assert made.status == status


def test_without_arm_coordinates_there_is_no_target():
    made = make_message(arm=False)
    assert not made.valid
    assert "NO_ARM_FRAME" in made.reasons


def test_half_a_target_is_none():
    record = make_record(ores=3)
    record["ores"][0]["strike"] = None
    record["ores"][1]["strike"]["direction"]["arm"] = None
    made = message(record, 1, Origin(), age_s=0.0, valid_for_s=5.0)
    assert [target.id for target in made.targets] == [3]
    assert "TARGET_INCOMPLETE" in made.reasons


@settings(deadline=None)
@given(age_s=st.floats(-100, 100), valid_for_s=st.floats(0.1, 60))
def test_an_old_frame_or_one_from_the_future_has_no_valid_target(age_s, valid_for_s):
    made = message(make_record(), 1, Origin(), age_s=age_s, valid_for_s=valid_for_s)
    if abs(age_s) > valid_for_s:
        assert not made.valid
        assert "EXPIRED" in made.reasons
    assert made.valid_until_ns - made.published_ns <= 1e9 * valid_for_s


def test_a_message_sent_late_goes_without_its_targets():
    made = make_message(valid_for_s=1.0)
    assert made.current().valid
    time.sleep(1.01)
    assert not made.current().valid
    assert made.current().sequence == made.sequence


@pytest.mark.parametrize(
    ("nanoseconds", "text"),
    [
        (1_795_000_000_123_456_789, "2026-11-18T11:06:40.123456789Z"),
        (0, "1970-01-01T00:00:00.000000000Z"),
        (-1, "1969-12-31T23:59:59.999999999Z"),
        (5, "1970-01-01T00:00:00.000000005Z"),
        (None, None),
        (2**63 - 1, "2262-04-11T23:47:16.854775807Z"),
        (10**21, None),
    ],
)
def test_times_are_told_to_the_nanosecond(nanoseconds, text):
    assert utc(nanoseconds) == text
    source = None if nanoseconds is None else "arrival"
    made = make_message(1, stamp_ns=nanoseconds, stamp_source=source).json()
    assert (made["stamp_ns"], made["stamp_utc"]) == (nanoseconds, text)
    assert made["stamp_source"] == source


def test_a_shortened_message_has_the_best_targets_and_says_so():
    made = make_message(ores=3)
    assert made.shortened(3) is made
    short = made.shortened(2)
    assert ([target.id for target in short.targets], short.reasons) == (
        [1, 2],
        ("TARGETS_LEFT_OUT",),
    )


def test_volume_and_deviations_come_with_a_target():
    record = make_record(ores=2)
    record["ores"][1] |= {"volume_m3": None, "centre_of_gravity": None}
    made = message(record, 1, Origin(), age_s=0.0, valid_for_s=5.0)
    assert [(t.volume_m3, t.sigma_m) for t in made.targets] == [
        (0.02, (0.01, 0.01, 0.02)),
        (None, None),
    ]


def test_transform_id_follows_the_transform():
    T = np.eye(4)
    T_moved = T.copy()
    T_moved[0, 3] = 1e-6
    assert transform_id(T) == transform_id(T.copy()) != transform_id(T_moved)
    assert transform_id(None) is None


def test_an_outbox_drops_the_oldest_and_counts():
    box = Outbox(3)
    for sequence in range(1, 6):
        box.put(make_message(sequence))
    assert [box.get(0).sequence for _ in range(3)] == [3, 4, 5]
    assert box.get(0) is None
    assert box.dropped == 2
    box.put(make_message(9))
    box.close()
    assert not box.finished
    assert box.get(0).sequence == 9
    assert box.finished


def test_targets_expire_by_themselves_within_the_stated_time():
    sink = ListSink()
    with Publisher([sink], valid_for_s=0.3) as publisher:
        publisher.publish(make_record(0), age_s=0.1)
        wait_for(lambda: len(sink.messages) == 2, what="withdrawal")
        (published_at, first), (withdrawn_at, second) = sink.messages
        assert first.valid
        assert not second.valid
        assert (second.status, second.reasons[-1], second.sequence) == (
            "expired",
            "EXPIRED",
            first.sequence + 1,
        )
        assert 0.15 < withdrawn_at - published_at < 3.0
        assert not publisher.latest.valid
        time.sleep(0.4)
        assert len(sink.messages) == 2, "a withdrawal is sent once"


def test_a_new_frame_renews_and_a_degraded_one_withdraws_at_once():
    sink = ListSink()
    with Publisher([sink], valid_for_s=2.0) as publisher:
        for index in range(8):
            publisher.publish(make_record(index), age_s=0.0)
            time.sleep(0.1)
        assert all(message.valid for _, message in sink.messages)
        publisher.publish(make_record(8, status="degraded"), age_s=0.0)
        assert not sink.messages[-1][1].valid
        time.sleep(2.2)
        assert len(sink.messages) == 9
    assert [message.sequence for _, message in sink.messages] == list(range(1, 11))
    assert sink.messages[-1][1].status == "stopped"


def test_targets_are_withdrawn_when_the_program_ends_with_an_error():
    sink = ListSink()

    def fails():
        with Publisher([sink], valid_for_s=60) as publisher:
            publisher.publish(make_record(0), age_s=0.0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert [message.valid for _, message in sink.messages] == [True, False]


def test_every_start_has_a_session_of_its_own():
    sinks = ListSink(), ListSink()
    for sink in sinks:
        with Publisher([sink], 1.0):
            time.sleep(0.001)
    assert sinks[0].messages[0][1].origin.session != sinks[1].messages[0][1].origin.session


def test_sinks_opened_before_a_fault_are_closed():
    class Refuses(ListSink):
        def __enter__(self):
            raise OutputError("no")

    closed = threading.Event()

    class Opens(ListSink):
        def __exit__(self, *_):
            closed.set()

    with pytest.raises(OutputError), Publisher([Opens(), Refuses()], 1.0):
        pass
    assert closed.is_set()


def test_a_message_is_never_changed():
    made = make_message()
    assert made.withdrawn("X") is not made
    assert made == replace(made)
