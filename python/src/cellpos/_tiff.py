"""Clips: the pages of a TIFF as the program writes it (grey, 8 or 16 bits, not compressed), with the times in a CSV."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Dict, List, Tuple

import numpy as np

Array = Any
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 16: 8}
_FORMS = {1: "B", 3: "H", 4: "I", 16: "Q"}


class Clip:
    """Pictures kept around a moment of a run."""

    def __init__(self, path: Path, offset_s: float = 0.0) -> None:
        #: The TIFF.
        self.path = path
        self._offset_s = offset_s

    def __repr__(self) -> str:
        return f"<Clip {self.path.stem}>"

    @property
    def frames(self) -> Array:
        """The pictures: frame, row, column."""
        return read_tiff(self.path)

    @property
    def times(self) -> Any:
        """The table of the CSV: frame, time_s (on the axis of the ticks), frame_id, place of the crop, place of the bead."""
        from ._run import Table, read_csv

        table = read_csv(self.path.with_suffix(".csv"))
        columns = {name: table[name] for name in table}
        if "time_s" in columns:
            columns["time_s"] = columns["time_s"] + self._offset_s
        return Table(list(columns), columns.__getitem__)


def read_tiff(path: Path) -> Array:
    """All pages of a TIFF of grey values that is not compressed."""
    data = path.read_bytes()
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or struct.unpack_from(order + "H", data, 2)[0] != 42:
        raise ValueError(f"{path}: not a TIFF")
    at = struct.unpack_from(order + "I", data, 4)[0]
    pages: List[Array] = []
    while at:
        count = struct.unpack_from(order + "H", data, at)[0]
        tags: Dict[int, Tuple[int, ...]] = {}
        for index in range(count):
            tag, kind, number, _ = struct.unpack_from(order + "HHII", data, at + 2 + 12 * index)
            if kind not in _FORMS:
                continue
            place = at + 10 + 12 * index
            if number * _SIZES[kind] > 4:
                place = struct.unpack_from(order + "I", data, place)[0]
            tags[tag] = struct.unpack_from(f"{order}{number}{_FORMS[kind]}", data, place)
        if tags.get(259, (1,))[0] != 1:
            raise ValueError(f"{path}: compressed pages are not read here; tifffile reads them")
        width, height, bits = tags[256][0], tags[257][0], tags.get(258, (8,))[0]
        strips = b"".join(data[o : o + n] for o, n in zip(tags[273], tags[279]))
        pages.append(np.frombuffer(strips, f"{order}u{bits // 8}", width * height).reshape(height, width))
        at = struct.unpack_from(order + "I", data, at + 2 + 12 * count)[0]
    return np.stack(pages) if pages else np.empty((0, 0, 0), np.uint8)
