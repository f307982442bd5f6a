"""The board's protocol, version 2, as docs/board.md has it: frames, numbers, messages."""

from __future__ import annotations

import zlib
from typing import Any, Dict, Iterator, List, Optional, Tuple, Union

PROTOCOL = 2
TO_BOARD, TO_HOST = 0xB1, 0x4E
_MOST_MESSAGE, _MOST_ENCODED = 96, 102

REQUESTS = ("Hello", "Arm", "Command", "Freeze", "Park", "Disarm", "Led")
REFUSALS = ("Protocol", "Limits", "Park", "Watchdog", "State", "Busy")
STATES = ("Disarmed", "Armed", "Running", "Frozen", "Safe", "Holding")
FAULTS = ("None", "CommandTimeout", "FreezeTimeout", "ArmTimeout")

_LIMITS: Tuple[Tuple[str, Any], ...] = (("low_pm", "i32"), ("high_pm", "i32"), ("slew_nm_per_s", "u32"))
#: Messages by number: name and fields, in the order of the tables of docs/board.md.
BOARD_MESSAGES: Tuple[Tuple[str, Tuple[Tuple[str, Any], ...]], ...] = (
    ("Hello", (("protocol", "u16"),)),
    (
        "Arm",
        (
            ("session", "u16"),
            ("watchdog_ms", ("?", "u16")),
            ("hold_watchdog_ms", ("?", "u16")),
            ("park_pm", ("?", "i32")),
            ("limits", ("?", _LIMITS)),
            ("interpolate", "bool"),
            ("status_every", "u16"),
        ),
    ),
    (
        "Command",
        (("session", "u16"), ("seq", "u32"), ("time_us", "u64"), ("displacement_pm", "i32"), ("neutral_pm", "i32")),
    ),
    ("Freeze", ()),
    ("Park", ()),
    ("Disarm", ()),
    ("Led", (("on", "bool"),)),
    ("StatusRequest", ()),
    ("Ping", (("token", "u32"),)),
)
HOST_MESSAGES: Tuple[Tuple[str, Tuple[Tuple[str, Any], ...]], ...] = (
    (
        "Identity",
        (
            ("protocol", "u16"),
            ("firmware", ("u8", "u8", "u8")),
            ("serial", "u32"),
            ("limits", _LIMITS),
            ("ramp_nm_per_s", "u32"),
            ("park_pm", "i32"),
            ("dac_bits", "u8"),
            ("watchdog_ms", "u16"),
            ("hold_watchdog_ms", "u16"),
        ),
    ),
    ("Ack", (("request", REQUESTS),)),
    ("Refused", (("request", REQUESTS), ("refusal", REFUSALS))),
    (
        "Status",
        (
            ("session", "u16"),
            ("last_seq", ("?", "u32")),
            ("last_time_us", "u64"),
            ("state", STATES),
            ("applied_pm", "i32"),
            ("neutral_pm", "i32"),
            ("board_time_us", "u64"),
            ("fault", FAULTS),
            ("led", "bool"),
            ("bad_frames", "u32"),
            ("ignored", "u32"),
            ("late", "u32"),
            ("clipped", "u32"),
            ("unsent", "u32"),
            ("holds", "u16"),
        ),
    ),
    ("Fault", (("fault", FAULTS), ("board_time_us", "u64"))),
    ("Pong", (("token", "u32"), ("board_time_us", "u64"))),
)
_BITS = {"u16": 16, "u32": 32, "u64": 64, "i32": 32}
Message = Tuple[str, Dict[str, Any]]


class Damaged(ValueError):
    """Bytes that are no message."""


def _is_fields(kind: Any) -> bool:
    return isinstance(kind, tuple) and bool(kind) and isinstance(kind[0], tuple)


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _write(kind: Any, value: Any) -> bytes:
    if _is_fields(kind):
        return b"".join(_write(of, value[name]) for name, of in kind)
    if isinstance(kind, tuple) and kind[0] == "?":
        return b"\0" if value is None else b"\1" + _write(kind[1], value)
    if isinstance(kind, tuple) and kind[0] == "u8":
        return bytes(value)
    if isinstance(kind, tuple):
        return _varint(kind.index(value))
    if kind in ("bool", "u8"):
        return bytes([int(value)])
    if kind == "i32":
        return _varint(value << 1 if value >= 0 else (-value << 1) - 1)
    return _varint(value)


class _Reader:
    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def byte(self) -> int:
        if self.at >= len(self.data):
            raise Damaged("too short")
        self.at += 1
        return self.data[self.at - 1]

    def varint(self, bits: int) -> int:
        number = shift = 0
        while True:
            byte = self.byte()
            number |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                break
            if shift >= bits:
                raise Damaged("a number is too long")
        if number >> bits:
            raise Damaged("a number does not fit its type")
        return number

    def read(self, kind: Any) -> Any:
        if kind == () or _is_fields(kind):
            return {name: self.read(of) for name, of in kind}
        if isinstance(kind, tuple) and kind[0] == "?":
            return self.read(kind[1]) if self.read("bool") else None
        if isinstance(kind, tuple) and kind[0] == "u8":
            return [self.byte() for _ in kind]
        if isinstance(kind, tuple):
            number = self.varint(32)
            if number >= len(kind):
                raise Damaged("a choice that there is not")
            return kind[number]
        if kind == "u8":
            return self.byte()
        if kind == "bool":
            byte = self.byte()
            if byte > 1:
                raise Damaged("neither true nor false")
            return bool(byte)
        number = self.varint(_BITS[kind])
        return (number >> 1) ^ -(number & 1) if kind == "i32" else number


def _cobs(data: bytes) -> bytes:
    # Frames are shorter than 254 bytes: no group is full.
    return b"".join(bytes([len(group) + 1]) + group for group in data.split(b"\0"))


def _uncobs(data: bytes) -> bytes:
    groups: List[bytes] = []
    at = 0
    while at < len(data):
        code = data[at]
        group = data[at + 1 : at + code]
        if code == 0 or len(group) != code - 1:
            raise Damaged("not COBS")
        groups.append(group)
        at += code
    return b"\0".join(groups)


def encode(direction: int, message: Message) -> bytes:
    """A message as it goes over the line."""
    name, fields = message
    table = BOARD_MESSAGES if direction == TO_BOARD else HOST_MESSAGES
    number = [known for known, _ in table].index(name)
    body = bytes([direction]) + _varint(number) + _write(table[number][1], fields) if table[number][1] else bytes([direction, number])
    return b"\0" + _cobs(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"


def decode(direction: int, frame: bytes) -> Message:
    """The message between two zeros; raises Damaged."""
    if len(frame) > _MOST_ENCODED:
        raise Damaged("too long")
    body = _uncobs(frame)
    if len(body) < 6 or body[0] != direction or zlib.crc32(body[:-4]).to_bytes(4, "little") != body[-4:]:
        raise Damaged("another direction, or a wrong check")
    reader = _Reader(body[1:-4])
    table = BOARD_MESSAGES if direction == TO_BOARD else HOST_MESSAGES
    number = reader.varint(32)
    if number >= len(table):
        raise Damaged("a message that there is not")
    name, kind = table[number]
    fields = reader.read(kind)
    if reader.at != len(reader.data):
        raise Damaged("too long")
    return name, fields


class Decoder:
    """Takes bytes in pieces of any size and gives the messages of one direction."""

    def __init__(self, direction: int) -> None:
        self.direction, self.bad_frames = direction, 0
        self._held: Union[bytearray, None] = bytearray()

    def messages(self, data: bytes) -> Iterator[Message]:
        pieces = data.split(b"\0")
        for index, piece in enumerate(pieces):
            held: Optional[bytearray] = self._held
            if held is not None:
                held += piece
                if len(held) > _MOST_ENCODED:
                    # Counted once, at its end.
                    self._held = held = None
            if index == len(pieces) - 1:
                return
            self._held = bytearray()
            if held is None:
                self.bad_frames += 1
            elif held:
                try:
                    yield decode(self.direction, bytes(held))
                except Damaged:
                    self.bad_frames += 1
