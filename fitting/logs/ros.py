"""Robot recordings: MCAP, and bags of ROS 1 and ROS 2; each field of a topic is a column."""

import json
import re
from collections.abc import Callable, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import InputError
from fitting.logs.extras import needing
from fitting.logs.raw_table import RawColumn, RawTable

_MOST_LISTED = 32  # most elements of an array
_DEEPEST = 8
_ENCODINGS = (("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg"))
_STEP = re.compile(r"([^\[\]]+)(?:\[([^\[\]]+)\])?")

Message = tuple[str, int, Any]
"""Topic, time of reception [ns], and message: an object with fields, or a mapping."""

_EXTRA = (
    "recordings of robots need mcap and rosbags; install them",
    "ros",
    "export the joint's topics as CSV",
)


def read_mcap(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted fields of an MCAP file with messages in ROS 1, ROS 2 or JSON.

    Args:
        path: named in messages.
        source: what is read.
        wanted: as in [`read_bag`][].

    Raises:
        InputError: The extra is not installed, or messages are in another encoding.
    """
    with needing(path, *_EXTRA):
        from mcap.reader import make_reader  # pyright: ignore[reportMissingImports]
    with source.open("rb") if isinstance(source, Path) else source as file:
        reader = make_reader(file)
        decoders: dict[int, Callable[[bytes], Any]] = {}

        def messages(topics: Iterable[str] | None) -> Iterator[Message]:
            for schema, channel, message in reader.iter_messages(topics):
                # If fields are only listed, those of other encodings are omitted.
                if topics is None and not _is_readable(schema, channel):
                    continue
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(path, schema, channel)
                yield channel.topic, message.log_time, decoders[channel.id](message.data)

        summary = reader.get_summary()
        known = None if summary is None else tuple(channel.topic for channel in summary.channels.values())
        return _table(known, messages, wanted)


def read_bag(path: Path, source: Path | BytesIO, wanted: tuple[str, ...]) -> RawTable:
    """The wanted fields of a bag of ROS 1 (`.bag`) or ROS 2 (`.db3`).

    Args:
        path: named in messages.
        source: what is read.
        wanted: topic and field, such as "/joint_states/position[0]", or "position[elbow]" by the name in the message.

    Raises:
        InputError: The extra is not installed, or the file is packed.
    """
    with needing(path, *_EXTRA):
        from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]
        from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]
    if isinstance(source, BytesIO):
        raise InputError(f"{path}: a bag is read from the file itself; unpack it")
    # Bags before ROS 2 Iron do not contain message definitions.
    with AnyReader([source], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:

        def messages(topics: Iterable[str] | None) -> Iterator[Message]:
            chosen = [c for c in reader.connections if topics is None or c.topic in topics]
            for connection, time, raw in reader.messages(connections=chosen) if chosen else ():
                yield connection.topic, time, reader.deserialize(raw, connection.msgtype)

        return _table(tuple(dict.fromkeys(c.topic for c in reader.connections)), messages, wanted)


def _is_readable(schema: Any, channel: Any) -> bool:
    """Whether a channel's encoding is supported."""
    form = None if schema is None else schema.encoding
    return channel.message_encoding == "json" or (channel.message_encoding, form) in _ENCODINGS


def _decoder(path: Path, schema: Any, channel: Any) -> Callable[[bytes], Any]:
    """Decoder of a channel's messages."""
    if channel.message_encoding == "json":
        return json.loads
    if not _is_readable(schema, channel):
        raise InputError(
            f"{path}: the messages of '{channel.topic}' are encoded as {channel.message_encoding!r}, which is not "
            "supported; export the joint's topics as CSV"
        )
    with needing(path, *_EXTRA):
        from rosbags import typesys  # pyright: ignore[reportMissingImports]
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    text = schema.data.decode()
    store.register(
        typesys.get_types_from_idl(text)
        if schema.encoding == "ros2idl"
        else typesys.get_types_from_msg(text, schema.name)
    )
    read = store.deserialize_ros1 if channel.message_encoding == "ros1" else store.deserialize_cdr
    return lambda raw: read(raw, schema.name)


def _table(
    topics: tuple[str, ...] | None,
    messages: Callable[[Iterable[str] | None], Iterator[Message]],
    wanted: tuple[str, ...],
) -> RawTable:
    """The wanted fields, each with the stamps of its topic's messages."""
    known = tuple(sorted({topic for topic, _, _ in messages(None)} if topics is None else topics, key=len))
    fields = {name: found for name in wanted if (found := _topic_and_field(name, known)) is not None}
    chosen: dict[str, list[str]] = {topic: [] for topic, _ in fields.values()}
    for topic, field in fields.values():
        chosen[topic].append(field)
    rows: dict[str, list[tuple[int, int, list[float]]]] = {topic: [] for topic in chosen}
    for topic, received, message in messages(chosen) if chosen else ():
        rows[topic].append((received, _stamp(message) or 0, [_value(message, field) for field in chosen[topic]]))
    # Sensor stamps are preferred, if all topics have them.
    own = all(stamp > 0 for several in rows.values() for _, stamp, _ in several)
    clocks = {
        topic: np.array([stamp if own else received for received, stamp, _ in several], dtype=np.int64)
        for topic, several in rows.items()
    }
    # A double holds no nanoseconds beside the seconds since 1970.
    origin = min((int(clock.min()) for clock in clocks.values() if len(clock)), default=0)
    columns = {}
    for name, (topic, field) in fields.items():
        place = chosen[topic].index(field)
        values = np.array([found[place] for _, _, found in rows[topic]], dtype=np.float64)
        if np.isfinite(values).any():
            columns[name] = RawColumn(values, time=(clocks[topic] - origin) * 1e-9)
    # Names of fields are only needed where one is missing, or none is wanted.
    names = () if columns and len(columns) == len(fields) else _names(known, messages)
    return RawTable(names or tuple(columns), columns)


def _topic_and_field(name: str, topics: tuple[str, ...]) -> tuple[str, str] | None:
    """The longest topic at the beginning of a name, and the rest."""
    found = [t for t in topics if name.strip("/").startswith(t.strip("/") + "/")]
    return (found[-1], name.strip("/")[len(found[-1].strip("/")) + 1 :]) if found else None


def _inside(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _stamp(message: Any) -> int | None:
    """The nanoseconds that a message's own header states."""
    stamp = _inside(_inside(message, "header"), "stamp")
    seconds = _inside(stamp, "sec")
    parts = next((p for k in ("nanosec", "nsec") if (p := _inside(stamp, k)) is not None), 0)
    return None if seconds is None else int(seconds) * 1_000_000_000 + int(parts)


def _value(message: Any, field: str) -> float:
    """The number in a field; NaN without one."""
    for step in re.split(r"[/.]", field):
        match = _STEP.fullmatch(step)
        if match is None:
            return np.nan
        found = _inside(message, match[1])
        message = found if match[2] is None else _element(found, match[2], _inside(message, "name"))
    try:
        return float(message)
    except (TypeError, ValueError):
        return np.nan


def _element(values: Any, which: str, names: Any) -> Any:
    """An element of an array, by its number from zero or by its name in the message."""
    known = [] if names is None else list(names)
    index = int(which) if which.isdigit() else known.index(which) if which in known else -1
    return values[index] if values is not None and 0 <= index < len(values) else None


def _names(topics: tuple[str, ...], messages: Callable[[Iterable[str] | None], Iterator[Message]]) -> tuple[str, ...]:
    """The numeric fields of each topic's first message."""
    firsts: dict[str, Any] = {}
    for topic, _, message in messages(None):
        firsts.setdefault(topic, message)
        if len(firsts) == len(topics):
            break
    return tuple(f"{topic}{rest}" for topic, message in firsts.items() for rest in _leaves(message, _DEEPEST))


def _leaves(value: Any, deepest: int) -> Iterator[str]:
    inside = value if isinstance(value, dict) else getattr(value, "__dict__", None)
    if isinstance(inside, dict) and deepest:
        for name, inner in inside.items():
            if not name.startswith("_"):
                yield from (f"/{name}{rest}" for rest in _leaves(inner, deepest - 1))
    elif isinstance(value, list | tuple | np.ndarray):
        for i, inner in enumerate(value[:_MOST_LISTED]):
            yield from (f"[{i}]{rest}" for rest in _leaves(inner, 0))
    elif isinstance(value, bool | int | float | np.number):
        yield ""
