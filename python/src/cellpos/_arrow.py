"""Reads ticks.arrow (an Arrow IPC stream of numbers) with NumPy alone, around whatever was cut off or damaged.

Only places and lengths are read at first. A column is taken from the file when it is asked for, and every length is checked
against the file before it is believed. Rows whose check (CRC-32) is wrong are left out and counted.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

import numpy as np

CHECK = "check"
_CONTINUATION = b"\xff\xff\xff\xff"
_SCHEMA, _RECORD_BATCH = 1, 3
_INT, _FLOAT = 2, 3


class Batch(NamedTuple):
    """Where the columns of some rows are in the file."""

    rows: int
    body: int
    offsets: "np.ndarray[Any, Any]"


class _Table:
    """A table of a flatbuffer."""

    def __init__(self, data: bytes, at: int) -> None:
        self.data, self.at = data, at
        self.fields = at - struct.unpack_from("<i", data, at)[0]
        self.size = struct.unpack_from("<H", data, self.fields)[0]

    def place(self, field: int) -> int:
        """Position of a field's value; 0 if the table has none."""
        slot = 4 + 2 * field
        if slot + 2 > self.size:
            return 0
        offset = int(struct.unpack_from("<H", self.data, self.fields + slot)[0])
        return self.at + offset if offset else 0

    def number(self, field: int, form: str) -> int:
        place = self.place(field)
        return int(struct.unpack_from(form, self.data, place)[0]) if place else 0

    def follow(self, field: int) -> int:
        """Position that a field's offset leads to."""
        place = self.place(field)
        if not place:
            raise ValueError("a field is missing")
        return place + int(struct.unpack_from("<I", self.data, place)[0])

    def table(self, field: int) -> "_Table":
        return _Table(self.data, self.follow(field))

    def tables(self, field: int) -> List["_Table"]:
        at = self.follow(field)
        count = struct.unpack_from("<I", self.data, at)[0]
        if count > len(self.data):
            raise ValueError("a list is longer than the file")
        places = [at + 4 + 4 * i for i in range(count)]
        return [_Table(self.data, p + struct.unpack_from("<I", self.data, p)[0]) for p in places]

    def text(self, field: int) -> str:
        at = self.follow(field)
        length = struct.unpack_from("<I", self.data, at)[0]
        return self.data[at + 4 : at + 4 + length].decode()

    def structs(self, field: int, form: str) -> "np.ndarray[Any, Any]":
        at = self.follow(field)
        count = struct.unpack_from("<I", self.data, at)[0]
        kind = np.dtype(form)
        if at + 4 + count * kind.itemsize > len(self.data):
            raise ValueError("a list is longer than the file")
        return np.frombuffer(self.data, kind, count, at + 4)


def _dtype(field: _Table) -> "np.dtype[Any]":
    kind, of = field.number(2, "<B"), field.table(3)
    if kind == _INT:
        bits, signed = of.number(0, "<i"), of.number(1, "<B")
        if bits in (8, 16, 32, 64):
            return np.dtype("<%s%d" % ("i" if signed else "u", bits // 8))
    if kind == _FLOAT:
        precision = of.number(0, "<h")
        if precision in (1, 2):
            return np.dtype("<f%d" % (4 * precision))
    raise ValueError("a column of a kind that a run does not have")


class Stream:
    """The batches of a file, and its missing parts."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.columns: Dict[str, Tuple[int, "np.dtype[Any]"]] = {}
        self.batches: List[Batch] = []
        #: Whether the file ends with the mark of a finished run.
        self.finished = False
        #: Bytes passed over because they made no sense.
        self.damaged_bytes = 0
        #: Rows whose check is wrong.
        self.damaged_rows = 0
        self._at = 0
        self._sound: List[Optional["np.ndarray[Any, Any]"]] = []
        self.more()

    def more(self) -> int:
        """Looks for batches that came since; gives how many."""
        before = len(self.batches)
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            while self._at + 8 <= size:
                found = self._message(file, self._at, size)
                if found is None:
                    behind = self._search(file, self._at + 8, size)
                    if behind is None:
                        # A batch that is still being written, or was cut off.
                        break
                    self.damaged_bytes += behind - self._at
                    self._at = behind
                    continue
                batch, end = found
                self.finished = end == self._at + 8
                if batch is not None:
                    self.batches.append(batch)
                    self._sound.append(None)
                self._at = end
        return len(self.batches) - before

    def _message(self, file: Any, at: int, size: int) -> Optional[Tuple[Optional[Batch], int]]:
        """The batch at a position (None: a message without rows) and the message's end; None if there is no message."""
        file.seek(at)
        mark = file.read(8)
        if len(mark) < 8 or mark[:4] != _CONTINUATION:
            return None
        length = struct.unpack("<I", mark[4:])[0]
        if length == 0:
            return None, at + 8
        if length > 1 << 20 or at + 8 + length > size:
            return None
        head = file.read(length)
        try:
            message = _Table(head, struct.unpack_from("<I", head, 0)[0])
            kind, body_length = message.number(1, "<B"), message.number(3, "<q")
            body = at + 8 + length
            if body_length < 0 or body + body_length > size:
                return None
            if kind == _SCHEMA:
                fields = message.table(2).tables(1)
                self.columns = {f.text(0): (i, _dtype(f)) for i, f in enumerate(fields)}
                return None, body + body_length
            if kind != _RECORD_BATCH or not self.columns:
                return None
            return self._batch(message.table(2), body, body_length), body + body_length
        except (struct.error, ValueError, IndexError, UnicodeDecodeError):
            return None

    def _batch(self, header: _Table, body: int, body_length: int) -> Batch:
        rows = header.number(0, "<q")
        nodes, buffers = header.structs(1, "<i8,<i8"), header.structs(2, "<i8,<i8")
        if header.place(3):
            raise ValueError("compressed")
        widths = np.array([kind.itemsize for _, kind in self.columns.values()])
        # Each column: a bitmap of what is there (none: all is) and the values.
        values = buffers[1::2]
        sound = (
            len(nodes) == len(widths)
            and len(buffers) == 2 * len(widths)
            and 0 <= rows <= body_length
            and bool(np.all(nodes["f0"] == rows))
            and bool(np.all(nodes["f1"] == 0))
            and bool(np.all(values["f0"] >= 0))
            and bool(np.all(values["f0"] + rows * widths <= body_length))
        )
        if not sound:
            raise ValueError("the columns are not whole")
        return Batch(rows, body, values["f0"].copy())

    def _search(self, file: Any, at: int, size: int) -> Optional[int]:
        """The next position, a multiple of eight, at which a message with content is."""
        at -= at % 8
        while at + 8 <= size:
            file.seek(at)
            block = file.read(1 << 16)
            words = np.frombuffer(block, "<u4", len(block) // 8 * 2)[::2]
            for index in np.flatnonzero(words == 0xFFFFFFFF):
                place = at + 8 * int(index)
                found = self._message(file, place, size)
                if found is not None and found[1] > place + 8:
                    return place
            at += 1 << 16
        return None

    def _map(self) -> "np.ndarray[Any, Any]":
        return np.memmap(self.path, np.uint8, "r")

    def _values(self, data: "np.ndarray[Any, Any]", batch: Batch, name: str) -> "np.ndarray[Any, Any]":
        index, kind = self.columns[name]
        start = batch.body + int(batch.offsets[index])
        return data[start : start + batch.rows * kind.itemsize].view(kind)

    def _checked(self, data: "np.ndarray[Any, Any]", number: int) -> "np.ndarray[Any, Any]":
        """Which rows of a batch are what was written."""
        known = self._sound[number]
        if known is not None:
            return known
        batch = self.batches[number]
        if CHECK not in self.columns:
            sound = np.ones(batch.rows, bool)
        else:
            parts = [
                self._values(data, batch, name).view(np.uint8).reshape(batch.rows, -1)
                for name in self.columns
                if name != CHECK
            ]
            rows = np.ascontiguousarray(np.hstack(parts)) if batch.rows else np.empty((0, 1), np.uint8)
            texts = rows.view("V%d" % rows.shape[1]).ravel().tolist()
            sums = np.fromiter(map(zlib.crc32, texts), np.uint32, batch.rows)
            sound = sums == self._values(data, batch, CHECK)
        self.damaged_rows += int(np.count_nonzero(~sound))
        self._sound[number] = sound
        return sound

    def rows(self) -> int:
        """How many rows are what was written."""
        if not self.batches:
            return 0
        data = self._map()
        return sum(int(np.count_nonzero(self._checked(data, i))) for i in range(len(self.batches)))

    def column(self, name: str, since: int = 0) -> "np.ndarray[Any, Any]":
        """A column, from a batch on."""
        kind = self.columns[name][1]
        if since >= len(self.batches):
            return np.empty(0, kind)
        data = self._map()
        parts = []
        for number in range(since, len(self.batches)):
            values, sound = self._values(data, self.batches[number], name), self._checked(data, number)
            parts.append(values if sound.all() else values[sound])
        return np.concatenate(parts)
