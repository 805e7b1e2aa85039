"""The content of a C3D file: header, parameters, and the numbers of its frames.

Every read is checked against the file's size, so that a damaged file gives one message.

A file begins with a header of 512 bytes. Its parameter section is a chain of records: a group,
or a parameter with type, dimensions and values. Its data section holds frame after frame: four
words per marker (x, y, z, residual and cameras), then the analog samples of that frame, channel
by channel. Words are 16-bit integers if the scale is positive, and 32-bit floats if it is
negative. Byte order and float format are those of the machine that wrote the file.

Format: C3D user guide, https://www.c3d.org.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array

BLOCK = 512
"""Bytes of a block. The format counts positions in blocks."""
LARGEST_16_BIT = 65535
"""Largest frame number of the header; longer recordings state theirs in TRIAL."""
EXPORT = "export the trial again as C3D"
MOST_DIMENSIONS = 7
"""Largest number of dimensions of a parameter, by the format."""
_KEY = 0x50
_DEC, _MIPS, _INTEL = 85, 86, 84
_SIZES = {-1: 1, 1: 1, 2: 2, 4: 4}
"""Type of a parameter -> bytes per value: text, byte, integer, float."""


@dataclass(frozen=True)
class Header:
    """The header, in the first block.

    Args:
        analog: analog values per frame, of all channels.
        samples: analog samples of a channel per frame.
        first: number of the first frame, from 1.
        last: number of the last frame.
        scale: length units per integer step; negative: the data are floats.
        data_block: first block of the data, from 1.
        rate_Hz: frames per second.
    """

    markers: int
    analog: int
    samples: int
    first: int
    last: int
    scale: float
    data_block: int
    rate_Hz: float

    @property
    def channels(self) -> int:
        """Number of analog channels."""
        return self.analog // self.samples if self.analog else 0


@dataclass(frozen=True, eq=False)
class Parameters:
    """Groups of named values.

    Args:
        values: "GROUP:NAME" -> array of numbers (the first index runs fastest in the file), or
            list of texts.
        damaged: names of the parameters whose record cannot be read.
    """

    path: Path
    values: dict[str, Any] = field(default_factory=dict)
    damaged: set[str] = field(default_factory=set)

    def get(self, name: str) -> Any:
        """Return the values of "GROUP:NAME"; None without such a parameter."""
        if name in self.damaged:
            raise InputError(f"has a damaged parameter {name}", self.path, EXPORT)
        return self.values.get(name)

    def number(self, name: str) -> float | None:
        """Return the first number of a parameter; None if it has none."""
        value = self.get(name)
        if value is None or isinstance(value, list) or not value.size:
            return None
        return float(value.ravel(order="F")[0])

    def numbers(self, name: str) -> Array | None:
        """Return the numbers of a parameter, in the shape that it states; None if it has none."""
        value = self.get(name)
        return None if value is None or isinstance(value, list) else np.asarray(value, float)

    def integers(self, name: str) -> list[int]:
        """Return whole numbers of a parameter, read as unsigned; empty if it has none."""
        value = self.numbers(name)
        result: list[float] = [] if value is None else value.ravel(order="F").tolist()
        return [int(v) & 0xFFFF if -32768 <= v < 0 else int(v) for v in result if math.isfinite(v)]

    def series(self, name: str) -> Array:
        """Return the values (n,) of NAME, NAME2, ..., each of which holds at most 255."""
        parts = [self.numbers(key) for key in self._numbered(name)]
        return np.concatenate([np.empty(0), *(p.ravel(order="F") for p in parts if p is not None)])

    def texts(self, name: str) -> list[str]:
        """Return the stripped texts of NAME, NAME2, ... in one list."""
        result: list[str] = []
        for key in self._numbered(name):
            value = self.get(key)
            result += value if isinstance(value, list) else []
        return result

    def _numbered(self, name: str) -> list[str]:
        keys = [k for k in (*self.values, *self.damaged) if k.startswith(name)]
        numbered = {k: k[len(name) :] for k in keys if k == name or k[len(name) :].isdigit()}
        return sorted(numbered, key=lambda k: int(numbered[k] or 1))


@dataclass(frozen=True, eq=False)
class C3dFile:
    """The content of a file.

    Args:
        first_frame: number of the first frame, counted from zero.
        points: (n, m, 3) in the file's length unit, gaps NaN.
        residual: (n, m) in the file's length unit; NaN in gaps.
        raw_analog: (k, c) analog words before offset and scale.
        notices: remarks on data that differ from the header or the parameters.
    """

    header: Header
    parameters: Parameters
    first_frame: int
    points: Array
    residual: Array
    raw_analog: Array
    notices: tuple[str, ...]


def parse_c3d(content: bytes, path: Path) -> C3dFile:
    """Return the content of a C3D file, from its bytes."""
    if len(content) < BLOCK or content[1] != _KEY:
        raise InputError("is not a C3D file", path, "give a recording in C3D")
    start = (content[0] - 1) * BLOCK
    if start < BLOCK or len(content) < start + 4:
        raise InputError("is cut short: its parameters are missing", path, "copy it again")
    machine = content[start + 3]
    if machine not in (_DEC, _MIPS, _INTEL):
        raise InputError(f"states an unknown machine code ({machine})", path, EXPORT)
    header = _header(content, machine)
    end = (header.data_block - 1) * BLOCK
    records = _parameters(content, start + 4, end if end > start else len(content), machine)
    parameters = Parameters(path, *records)
    header, notices = _agreed_header(content, header, parameters, machine, path)
    _check_scale(header, parameters, path)
    return _Data(content, header, parameters, machine, path).read(notices)


def _header(content: bytes, machine: int) -> Header:
    words = np.frombuffer(content, ">u2" if machine == _MIPS else "<u2", 10)
    scale = _floats(content[12:16], machine)[0]
    rate = _floats(content[20:24], machine)[0]
    _, markers, analog, first, last, _, _, _, block, samples = (int(word) for word in words)
    return Header(markers, analog, samples, first, last, float(scale), block, float(rate))


def _floats(content: bytes, machine: int) -> Array:
    """Return 32-bit floats of a machine.

    DEC floats have exchanged 16-bit halves and an exponent larger by two.
    """
    if machine != _DEC:
        kind = ">f4" if machine == _MIPS else "<f4"
        return np.frombuffer(content, kind).astype(float)
    halves = np.frombuffer(content, "<u2").reshape(-1, 2)[:, ::-1]
    return np.ascontiguousarray(halves).view("<f4").ravel().astype(float) / 4.0


def _parameters(
    content: bytes, position: int, end: int, machine: int
) -> tuple[dict[str, Any], set[str]]:
    """Return "GROUP:NAME" -> values, and the names of the damaged parameters.

    Args:
        position: first byte of the chain of records.
        end: largest possible end of the chain, byte.
    """
    order = "big" if machine == _MIPS else "little"
    groups: dict[int, str] = {}
    records: list[tuple[int, str, int, int]] = []
    end = min(end, len(content))
    while position + 2 <= end:
        size, group = (int(v) for v in np.frombuffer(content, "i1", 2, position))
        size = abs(size)
        link = position + 2 + size
        if size == 0 or link + 2 > end:
            break
        name = _text(content[position + 2 : link]).upper()
        offset = int.from_bytes(content[link : link + 2], order)  # type: ignore[arg-type]
        after = link + offset if offset else end
        if group < 0:
            groups[-group] = name
        elif group > 0:
            records.append((group, name, link + 2, min(after, end)))
        if offset < 2:
            break
        position = after
    values: dict[str, Any] = {}
    damaged: set[str] = set()
    for group, name, first, last in records:
        key = f"{groups.get(group, group)}:{name}"
        value = _value(content[first:last], machine)
        if value is None:
            damaged.add(key)
        else:
            values[key] = value
    return values, damaged - set(values)


def _text(content: bytes) -> str:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return text.replace("\x00", " ").strip()


def _value(record: bytes, machine: int) -> Any:
    if len(record) < 2:
        return None
    kind, dimensions = int(np.frombuffer(record, "i1", 1)[0]), record[1]
    shape = tuple(record[2 : 2 + dimensions])
    if kind not in _SIZES or len(shape) != dimensions or dimensions > MOST_DIMENSIONS:
        return None
    count = math.prod(shape)
    first = 2 + dimensions
    body = record[first : first + count * _SIZES[kind]]
    if len(body) < count * _SIZES[kind]:
        return None
    if kind == -1:
        width = shape[0] if shape else 1
        rows = count // width if width else 0
        return [_text(body[k * width : (k + 1) * width]) for k in range(rows)]
    if kind == 4:
        return _floats(body, machine).reshape(shape, order="F")
    number = {1: "i1", 2: ">i2" if machine == _MIPS else "<i2"}[kind]
    return np.frombuffer(body, number).astype(float).reshape(shape, order="F")


def _agreed_header(
    content: bytes, header: Header, parameters: Parameters, machine: int, path: Path
) -> tuple[Header, list[str]]:
    """Return the header whose layout fits the file, and a notice on a contradiction.

    The frames of exactly one of the layouts must then end within the file's last block.
    """
    error = _disagreement(header, parameters, path)
    if error is None:
        return header, []
    layouts: dict[tuple[int, int, bool], Header] = {}
    stated = list(_layouts(header, parameters))
    stated.sort(key=lambda other: _disagreement(other, parameters, path) is not None)
    for other in stated:
        if _Data(content, other, parameters, machine, path).fits():
            layouts.setdefault((other.markers, other.analog, other.scale < 0), other)
    if len(layouts) != 1:
        raise error
    (result,) = layouts.values()
    kind = "floats" if result.scale < 0 else "integers"
    return result, [
        f"{error.what}; the size of the file fits {result.markers} markers and {result.channels} "
        f"analog channels with {result.samples} samples per frame, as {kind}"
    ]


def _layouts(header: Header, parameters: Parameters) -> Iterator[Header]:
    """Yield the headers of all layouts that header and parameters state.

    Some programs write the number of channels as the number of analog values per frame.
    """
    used = parameters.integers("ANALOG:USED")[:1]
    rates = [parameters.number(f"{group}:RATE") or 0.0 for group in ("ANALOG", "POINT")]
    ratio = [round(rates[0] / rates[1])] if all(math.isfinite(r) and r > 0 for r in rates) else []
    scale = parameters.number("POINT:SCALE")
    scales = [header.scale, *([] if scale is None else [scale])]
    for samples, channels in product([header.samples, *ratio], [*used, header.analog, None]):
        if channels is None and (not samples or header.analog % samples):
            continue
        analog = header.analog if channels is None else channels * samples
        markers = [header.markers, *parameters.integers("POINT:USED")[:1]]
        for count, size in product(markers, scales):
            if math.isfinite(size) and size != 0:
                yield replace(header, markers=count, analog=analog, samples=samples, scale=size)


def _disagreement(header: Header, parameters: Parameters, path: Path) -> InputError | None:
    """Return how header and parameters contradict each other, or None."""
    used = parameters.integers("POINT:USED")
    if used and used[0] != header.markers:
        return InputError(
            f"holds {header.markers} markers by its header, {used[0]} by POINT:USED", path, EXPORT
        )
    if header.analog and (not header.samples or header.analog % header.samples):
        return InputError(
            f"states {header.analog} analog values per frame, which is no multiple of its "
            f"{header.samples} samples per frame",
            path,
            EXPORT,
        )
    channels = parameters.integers("ANALOG:USED")
    if channels and header.analog and channels[0] != header.channels:
        return InputError(
            f"holds {header.channels} analog channels by its header, {channels[0]} by ANALOG:USED",
            path,
            EXPORT,
        )
    scale = parameters.number("POINT:SCALE")
    stored_otherwise = scale is not None and (scale < 0) != (header.scale < 0)
    if stored_otherwise and (header.markers or header.analog):
        return InputError(
            "holds floats by its header and integers by POINT:SCALE, or the reverse", path, EXPORT
        )
    return None


def _check_scale(header: Header, parameters: Parameters, path: Path) -> None:
    if not math.isfinite(header.scale) or (header.scale == 0 and header.markers):
        raise InputError(f"has a scale of {header.scale:g} for its markers", path, EXPORT)
    scale = parameters.number("POINT:SCALE")
    differs = scale is not None and not math.isclose(scale, header.scale, rel_tol=1e-3)
    if header.scale > 0 and header.markers and differs and scale is not None and scale > 0:
        raise InputError(
            f"has a scale of {header.scale:g} by its header, {scale:g} by POINT:SCALE", path, EXPORT
        )


@dataclass(frozen=True, eq=False)
class _Data:
    content: bytes
    header: Header
    parameters: Parameters
    machine: int
    path: Path

    @property
    def _word(self) -> int:
        return 4 if self.header.scale < 0 else 2

    @property
    def _frame(self) -> int:
        return (4 * self.header.markers + self.header.analog) * self._word

    def fits(self) -> bool:
        stated = [self.header.data_block, *self.parameters.integers("POINT:DATA_START")[:1]]
        blocks = [block for block in stated if block > self.content[0]]
        return self._frame > 0 and any(self._fits((block - 1) * BLOCK) for block in blocks)

    def read(self, notices: list[str]) -> C3dFile:
        if not self._frame:
            raise self._empty()
        start = self._start(notices)
        stored = max(len(self.content) - start, 0) // self._frame
        count = self._count(stored, notices)
        words = self._words(self.content[start : start + count * self._frame]).reshape(count, -1)
        markers = 4 * self.header.markers
        points, residual = self._points(words[:, :markers].reshape(count, markers // 4, 4))
        samples = count * self.header.samples if self.header.analog else count
        analog = words[:, markers:].reshape(samples, self.header.channels)
        first = self._first()
        return C3dFile(
            self.header, self.parameters, first, points, residual, analog, tuple(notices)
        )

    def _empty(self) -> InputError:
        rotations = self.parameters.texts("ROTATION:LABELS")
        if not rotations and not self.parameters.integers("ROTATION:USED"):
            return InputError("holds neither markers nor analog channels", self.path, EXPORT)
        count = (self.parameters.integers("ROTATION:USED") or [len(rotations)])[0]
        return InputError(
            f"holds rotations of {count} segments, and no markers",
            self.path,
            "export marker positions, or joint angles of the model for --motion",
        )

    def _start(self, notices: list[str]) -> int:
        """Header and POINT:DATA_START both state the first block of the data. If they differ, the
        frames must fit the file from exactly one of the two.
        """
        stated = self.parameters.integers("POINT:DATA_START")
        blocks = list(dict.fromkeys([self.header.data_block, *stated[:1]]))
        after = self.content[0]
        usable = [b for b in blocks if b > after and (b - 1) * BLOCK <= len(self.content)]
        if not usable:
            raise InputError("is cut short: its data are missing", self.path, "copy it again")
        fitting = [b for b in usable if self._fits((b - 1) * BLOCK)]
        if len(blocks) > 1 and len(fitting) != 1 and blocks[1] != 0:
            raise InputError(
                f"has its data at block {blocks[0]} by its header, {blocks[1]} by POINT:DATA_START",
                self.path,
                EXPORT,
            )
        chosen = fitting[0] if fitting else usable[0]
        if chosen != self.header.data_block:
            notices.append(f"its data begin at block {chosen}, as POINT:DATA_START says")
        return (chosen - 1) * BLOCK

    def _fits(self, start: int) -> bool:
        spare = len(self.content) - start - self._stated() * self._frame
        return 0 <= spare < BLOCK

    def _first(self) -> int:
        trial = self.parameters.integers("TRIAL:ACTUAL_START_FIELD")
        first = self.header.first
        if len(trial) == 2:
            number = trial[0] + (LARGEST_16_BIT + 1) * trial[1]
            if number & LARGEST_16_BIT == first:
                first = number
        return max(first - 1, 0)

    def _stated(self) -> int:
        """The header's frame numbers have 16 bits. Longer recordings state the number in the two
        words of TRIAL, or else in POINT:LONG_FRAMES or POINT:FRAMES.
        """
        wrap = LARGEST_16_BIT + 1
        begin, end = (
            self.parameters.integers(f"TRIAL:ACTUAL_{name}_FIELD") for name in ("START", "END")
        )
        header = self.header.last - self.header.first + 1
        if len(begin) == 2 and len(end) == 2:
            count = end[0] + wrap * end[1] - begin[0] - wrap * begin[1] + 1
            saturated = self.header.last >= LARGEST_16_BIT
            if count > 0 and (saturated or (count - header) % wrap == 0):
                return count
        for name in ("POINT:LONG_FRAMES", "POINT:FRAMES"):
            longer = self.parameters.number(name)
            if longer and math.isfinite(longer) and longer > max(header, LARGEST_16_BIT):
                return int(longer)
        return header

    def _count(self, stored: int, notices: list[str]) -> int:
        """Return the number of frames to read, of at most `stored` ones."""
        stated = self._stated()
        other = self.parameters.integers("POINT:FRAMES")
        spare = math.ceil(BLOCK / self._frame)
        if other and other[0] != stated and stored - spare <= other[0] <= stored != stated:
            notices.append(f"it holds {other[0]} frames, as POINT:FRAMES says, not {stated}")
            stated = other[0]
        uncounted = self.header.last >= LARGEST_16_BIT or stored > stated + LARGEST_16_BIT
        if uncounted and stored > stated + spare:
            raise InputError(
                f"states {stated} frames, but is long enough for {stored}",
                self.path,
                "export it with TRIAL:ACTUAL_END_FIELD, or cut the trial",
            )
        if stated < 1:
            raise InputError(f"states {stated} frames", self.path, EXPORT)
        if stored < stated:
            share = 100.0 * stored / stated
            raise InputError(
                f"is cut short: it holds {share:.0f} % of its {stated} frames",
                self.path,
                "copy it again",
            )
        return stated

    def _words(self, body: bytes) -> Array:
        if self._word == 4:
            return _floats(body, self.machine)
        signs = self.parameters.texts("ANALOG:FORMAT")
        words = np.frombuffer(body, ">i2" if self.machine == _MIPS else "<i2").astype(float)
        if signs and signs[0].upper() == "UNSIGNED":
            analog = words.reshape(-1, self._frame // 2)[:, 4 * self.header.markers :]
            analog[analog < 0] += LARGEST_16_BIT + 1
        return words

    def _points(self, words: Array) -> tuple[Array, Array]:
        """Return positions (n, m, 3) and residuals (n, m) in the file's unit, gaps NaN.

        A marker's fourth word has the cameras in its high byte and the residual, in units of the
        scale, in its low byte. It is negative if the marker is missing.
        """
        scale = abs(self.header.scale)
        positions = words[:, :, :3] * (1.0 if self._word == 4 else scale)
        fourth = words[:, :, 3]
        readable = np.isfinite(fourth) & (np.abs(fourth) < 2**31)
        low_byte = np.where(readable, fourth, 0.0).astype(np.int64) & 0xFF
        residual = np.asarray(low_byte * scale, float)
        gap = ~np.isfinite(positions).all(axis=2) | (fourth < 0) | (positions == 0).all(axis=2)
        positions[gap], residual[gap] = np.nan, np.nan
        return positions, residual
