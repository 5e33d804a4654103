"""ROS recordings: each field of a topic is a column with the time stamps of its messages."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fitting.errors import InputError
from fitting.logs.read_table import read_table

COUNT = 20
START = 1_700_000_000_123_456_789
STEP = 1_000_000
LATE = 300_000 * (np.arange(COUNT) % 3)
POSITION = np.random.default_rng(0).normal(size=(COUNT, 2))
EFFORT = POSITION[:, ::-1] * 3
WANTED = ("/joint_states/position[0]", "joint_states/position[elbow]", "/joint_states/effort[1]", "/arm/command/data")


def to_json(path: Path) -> None:
    writer = pytest.importorskip("mcap.writer", reason="needs the extra `ros`: mcap is not installed")
    with path.open("wb") as file:
        out = writer.Writer(file)
        out.start()
        schema = out.register_schema("any", "jsonschema", b"{}")
        joints = out.register_channel("/joint_states", "json", schema)
        command = out.register_channel("/arm/command", "json", schema)
        for i in range(COUNT):
            stamp = divmod(START + i * STEP, 1_000_000_000)
            header = {"stamp": {"sec": stamp[0], "nsec": stamp[1]}}
            state = {"header": header, "name": ["shoulder", "elbow"], "position": POSITION[i].tolist()}
            state["effort"] = EFFORT[i].tolist()
            when = START + i * STEP + int(LATE[i])
            out.add_message(joints, when, json.dumps(state).encode(), when)
            out.add_message(command, when, json.dumps({"header": header, "data": float(i)}).encode(), when)
        out.finish()


def messages(store, number):
    """Joint states, and a command without a header."""
    types = store.types
    for i in range(COUNT):
        seconds, rest = divmod(START + i * STEP, 1_000_000_000)
        time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        counted = {"seq": i} if number == 1 else {}
        header = types["std_msgs/msg/Header"](stamp=time, frame_id="", **counted)
        state = types["sensor_msgs/msg/JointState"](
            header, ["shoulder", "elbow"], POSITION[i].copy(), np.zeros(2), EFFORT[i].copy()
        )
        yield START + i * STEP + int(LATE[i]), state, types["std_msgs/msg/Float64"](float(i))


def to_ros1(path: Path) -> None:
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="needs the extra `ros`: rosbags is not installed")
    from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]

    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as out:
        kinds = ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64")
        topics = [
            out.add_connection(topic, kind, typestore=store)
            for topic, kind in zip(("/joint_states", "/arm/command"), kinds, strict=True)
        ]
        for when, *both in messages(store, 1):
            for topic, kind, message in zip(topics, kinds, both, strict=True):
                out.write(topic, when, store.serialize_ros1(message, kind))


def to_ros2(path: Path, storage: str) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs the extra `ros`: rosbags is not installed")
    from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]

    store = get_typestore(Stores.ROS2_HUMBLE)
    folder = path.parent / "bag"
    plugin = getattr(rosbag2.StoragePlugin, storage)
    with rosbag2.Writer(folder, version=8, storage_plugin=plugin) as out:
        kinds = ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64")
        topics = [
            out.add_connection(topic, kind, typestore=store)
            for topic, kind in zip(("/joint_states", "/arm/command"), kinds, strict=True)
        ]
        for when, *both in messages(store, 2):
            for topic, kind, message in zip(topics, kinds, both, strict=True):
                out.write(topic, when, store.serialize_cdr(message, kind))
    next(folder.glob(f"*{path.suffix}")).rename(path)


FORMATS: dict[str, tuple[str, Callable[[Path], None], bool]] = {
    "MCAP with JSON": (".mcap", to_json, True),
    "MCAP of ROS 2": (".mcap", lambda path: to_ros2(path, "MCAP"), False),
    "ROS 2": (".db3", lambda path: to_ros2(path, "SQLITE3"), False),
    "ROS 1": (".bag", to_ros1, False),
}


@pytest.mark.parametrize("name", FORMATS)
def test_topic_fields_are_columns_with_message_stamps(tmp_path: Path, name: str):
    suffix, write, all_have_headers = FORMATS[name]
    path = tmp_path / f"log{suffix}"
    write(path)
    table = read_table(path, WANTED)
    assert set(table.columns) == set(WANTED)
    for column, expected in zip(WANTED, (POSITION[:, 0], POSITION[:, 1], EFFORT[:, 1], range(COUNT)), strict=True):
        np.testing.assert_array_equal(table.columns[column].values, expected)
        time = table.columns[column].time
        assert time is not None
        # Where one topic has no header, the times of receipt apply to all topics.
        late = 0.0 if all_have_headers else LATE * 1e-9
        np.testing.assert_allclose(time, np.arange(COUNT) * 1e-3 + late, atol=1e-12)
    alone = read_table(path, WANTED[:1]).columns[WANTED[0]].time
    assert alone is not None
    np.testing.assert_allclose(alone, np.arange(COUNT) * 1e-3, atol=1e-12)
    missing = read_table(path, (*WANTED, "/joint_states/positions[0]"))
    assert "/joint_states/position[1]" in missing.names and "/arm/command/data" in missing.names
    assert set(missing.columns) == set(WANTED)


def test_unsupported_message_encoding_is_refused(tmp_path: Path):
    writer = pytest.importorskip("mcap.writer", reason="needs the extra `ros`: mcap is not installed")
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        out = writer.Writer(file)
        out.start()
        schema = out.register_schema("any", "protobuf", b"")
        channel = out.register_channel("/joint_states", "protobuf", schema)
        out.add_message(channel, START, b"", START)
        out.finish()
    with pytest.raises(InputError, match="'/joint_states' are encoded as 'protobuf'"):
        read_table(path, WANTED)
    assert read_table(path, ("/other/data",)).names == ()


@pytest.mark.parametrize(("name", "head"), [("log.mcap", b"\x89MCAP0\r\n"), ("log.bag", b"#ROSBAG V2.0\n")])
def test_broken_recordings_are_refused(tmp_path: Path, name: str, head: bytes):
    path = tmp_path / name
    path.write_bytes(head + bytes(100))
    with pytest.raises(InputError, match="log"):
        read_table(path, WANTED)
