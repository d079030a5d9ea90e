"""Schema text and message layouts, against mcap-ros2-support."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from sensors.errors import EgolocError
from sensors.mcap import cdr
from sensors.mcap.io import read_log
from sensors.records import Imu, LeftOut, Log
from tests.sensors.mcap.messages import START_NS, Sent, encode, imu_messages, imu_value, nested

Save = Callable[..., Path]

TEXT = """# a comment
uint8 CONSTANT = 3
string NAME="x # y"
std_msgs/Header header
bool flag   # trailing comment
float64 a
uint16[3] fixed
float32[] many
string label "default"
int64[<=5] bounded
Point[2] pair
Point[] cloud
string[] names
float64 last 1.5
===========================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string<=20 frame_id
===========================
MSG: test_msgs/Point
float32 x
float64 y
"""
NUMBERS = st.integers(0, 100)
POINTS = st.fixed_dictionaries({"x": NUMBERS, "y": NUMBERS})


@settings(max_examples=60, deadline=None)
@given(
    value=st.fixed_dictionaries(
        {
            "header": st.fixed_dictionaries(
                {
                    "stamp": st.fixed_dictionaries({"sec": NUMBERS, "nanosec": NUMBERS}),
                    "frame_id": st.text("abé", max_size=9),
                }
            ),
            "flag": st.booleans(),
            "a": NUMBERS,
            "fixed": st.lists(NUMBERS, min_size=3, max_size=3),
            "many": st.lists(NUMBERS, max_size=5),
            "label": st.text("xyz", max_size=9),
            "bounded": st.lists(NUMBERS, max_size=5),
            "pair": st.lists(POINTS, min_size=2, max_size=2),
            "cloud": st.lists(POINTS, max_size=3),
            "names": st.lists(st.text("ab", max_size=5), max_size=3),
            "last": NUMBERS,
        }
    )
)
def test_walk_finds_every_field(value: dict) -> None:
    data = serialize_dynamic("test_msgs/msg/All", TEXT)["test_msgs/msg/All"](value)
    assert generate_dynamic("test_msgs/msg/All", TEXT)["test_msgs/msg/All"](data).last == value["last"]
    found = cdr.walk(cdr.parse_schema("test_msgs/msg/All", TEXT), data)

    def numbers(path: str) -> list[float]:
        leaf = found.leaves[path]
        return np.frombuffer(data, leaf.dtype, leaf.length, leaf.offset).tolist()

    def text(path: str) -> str:
        offset, size = found.texts[path]
        return data[offset : offset + size].rstrip(b"\0").decode()

    assert found.size == len(data)
    assert numbers("header.stamp.sec") == [value["header"]["stamp"]["sec"]]
    assert text("header.frame_id") == value["header"]["frame_id"]
    for name in ("flag", "a", "last"):
        assert numbers(name) == [value[name]]
    for name in ("fixed", "many", "bounded"):
        assert numbers(name) == value[name]
    for name in ("pair", "cloud"):
        for k, point in enumerate(value[name]):
            assert (numbers(f"{name}[{k}].x"), numbers(f"{name}[{k}].y")) == ([point["x"]], [point["y"]])
    assert [text(f"names[{k}]") for k in range(len(value["names"]))] == value["names"]


def test_bare_type_names_belong_to_the_package_or_are_the_header() -> None:
    schema = cdr.parse_schema("p/msg/T", "Header header\nE e\n====\nMSG: p/E\n====\nMSG: std_msgs/Header\nint8 x")
    assert [member.type for member in schema.definitions["p/T"]] == ["std_msgs/Header", "p/E"]


def test_schema_mistakes_are_named() -> None:
    for text, expected in (
        ("Missing x", "type p/Missing is not defined"),
        ("T x", "type p/T contains itself"),
        ("wstring x", "wstring is not supported"),
        ("float64 x\n====\nnonsense", "expected a line 'MSG: package/Type'"),
    ):
        with pytest.raises(EgolocError, match=expected):
            cdr.parse_schema("p/msg/T", text)
    schema = cdr.parse_schema("test_msgs/msg/All", TEXT)
    assert cdr.field_dtype(schema, "pair[1].y") == "<f8"
    assert cdr.field_dtype(schema, "fixed[2]") == "<u2"
    for path in ("nothing", "header", "fixed", "fixed[3]", "label", "many[0]", "a.b", "a[0]"):
        with pytest.raises(EgolocError, match="expected a number at"):
            cdr.field_dtype(schema, path)


def test_a_schema_nested_without_end_is_refused() -> None:
    sections = [f"MSG: p/T{k}\nT{k + 1} a\nT{k + 1} b" for k in range(60)]
    with pytest.raises(EgolocError, match="nested too deep"):
        cdr.parse_schema("p/msg/T", "\n====\n".join(["T0 a", *sections, "MSG: p/T60\nint8 a"]))


def test_wrong_lengths_cost_no_time_and_no_memory() -> None:
    schema = cdr.parse_schema("p/msg/T", "E[] many\n====\nMSG: p/E\n")
    start = time.perf_counter()
    with pytest.raises(cdr.MalformedMessageError, match="shorter"):
        cdr.walk(schema, b"\x00\x01\x00\x00\xff\xff\xff\xff" + bytes(100))
    with pytest.raises(cdr.MalformedMessageError, match="larger"):
        cdr.walk(schema, b"\x00\x01\x00\x00" + bytes(1 << 20))
    with pytest.raises(cdr.MalformedMessageError, match="longer"):
        cdr.walk(schema, b"\x00\x01\x00\x00" + bytes(100))
    assert time.perf_counter() - start < 5


def imu_of(log: Log) -> Imu:
    assert log.imu is not None
    return log.imu


@pytest.mark.parametrize("length", range(9))
def test_every_length_of_frame_id(save: Save, length: int) -> None:
    messages = imu_messages(5, frame="f" * length)
    log = read_log(save(messages))
    assert log.left_out == ()
    assert imu_of(log).accel[:, 2].tolist() == [m.value["linear_acceleration"]["z"] for m in messages]  # type: ignore[index]


def test_frame_ids_that_change_from_message_to_message(save: Save) -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=(500, 6))
    messages = [
        Sent("/imu", "sensor_msgs/Imu", imu_value(t, row[:3], row[3:], "x" * int(rng.integers(0, 300))), t)
        for t, row in zip(range(START_NS, START_NS + 500 * 10**7, 10**7), values, strict=True)
    ]
    log = read_log(save(messages))
    assert log.left_out == ()
    np.testing.assert_array_equal(np.column_stack((imu_of(log).gyro, imu_of(log).accel)), values)


def test_sequences_that_change_their_length(save: Save) -> None:
    messages = []
    for k in range(40):
        value = nested(
            {
                "header": {"stamp": {"sec": START_NS // 10**9 + k, "nanosec": 0}, "frame_id": "gps"},
                "status.header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
                "status.satellite_used_prn": list(range(k % 7)),
                "status.satellite_visible_snr": list(range(k % 5)),
                "status.status": 19,
                "latitude": 49.0 + k * 1e-6,
                "position_covariance": [0.01 if i in {0, 4, 8} else 0.0 for i in range(9)],
                "position_covariance_type": 2,
            }
        )
        messages.append(Sent("/fix", "gps_msgs/GPSFix", value, START_NS + k * 10**9))
    log = read_log(save(messages))
    assert log.gnss is not None
    assert log.left_out == ()
    np.testing.assert_array_equal(log.gnss.llh[:, 0], np.radians(49.0 + np.arange(40) * 1e-6))


def test_fields_in_another_order_and_precision(save: Save) -> None:
    text = """float32[9] linear_acceleration_covariance
Three linear_acceleration
float64[9] angular_velocity_covariance
Three angular_velocity
string note
std_msgs/Header header
====
MSG: sensor_msgs/Three
float32 z
float32 y
float32 x
====
MSG: std_msgs/Header
string frame_id
builtin_interfaces/Time stamp
"""
    value = imu_value(START_NS, (1, 2, 3), (4, 5, 6)) | {"note": "odd"}
    data = serialize_dynamic("sensor_msgs/msg/Imu", text)["sensor_msgs/msg/Imu"](value)
    log = read_log(save([Sent("/imu", "sensor_msgs/Imu", data, START_NS)], texts={"sensor_msgs/Imu": text}))
    assert imu_of(log).gyro.tolist() == [[1, 2, 3]]
    assert imu_of(log).accel.tolist() == [[4, 5, 6]]
    assert imu_of(log).t_ns.tolist() == [START_NS]


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        (b"\x00\x00", "big-endian CDR (header 00 00), expected little-endian CDR (00 01)"),
        (b"\x00\x07", "XCDR2 (header 00 07), expected little-endian CDR (00 01)"),
        (b"\x00\x03", "PL_CDR (header 00 03), expected little-endian CDR (00 01)"),
        (b"\x0a\x01", "not CDR (header 0a 01), expected little-endian CDR (00 01)"),
    ],
)
def test_other_encodings_are_left_out_with_their_name(save: Save, head: bytes, reason: str) -> None:
    good = imu_messages(4)
    data = encode("sensor_msgs/Imu", imu_value(START_NS + 10**9, (1, 2, 3), (4, 5, 6)))
    bad = [Sent("/imu", "sensor_msgs/Imu", head + data[2:], START_NS + 10**9)] * 3
    log = read_log(save(bad + good))
    assert log.left_out == (LeftOut("/imu", reason, 3),)
    assert len(imu_of(log)) == 4
    log = read_log(save(bad))
    assert log.imu is None
    assert log.left_out == (LeftOut("/imu", reason, 3),)


def test_messages_of_the_wrong_size_are_left_out(save: Save) -> None:
    data = encode("sensor_msgs/Imu", imu_value(START_NS, (1, 2, 3), (4, 5, 6)))
    sizes = [data[:100], data[:3], data + bytes(8), data + bytes(7), b""]
    messages = [Sent("/imu", "sensor_msgs/Imu", d, START_NS + k) for k, d in enumerate(sizes)]
    log = read_log(save(messages))
    assert len(imu_of(log)) == 1
    assert {(row.reason, row.count) for row in log.left_out} == {
        ("message is shorter than its schema says", 1),
        ("message is shorter than a CDR header", 2),
        ("message is longer than its schema says", 1),
    }
