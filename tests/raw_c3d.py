"""Writer of C3D files in the number format of any machine, as integers or floats."""

import struct
from pathlib import Path

import numpy as np

MACHINES = {"intel": 84, "dec": 85, "mips": 86}


class RawC3d:
    """Writes a recording with any parameters, in the number format of a machine."""

    def __init__(self, machine="intel", *, integers=False, scale=0.1, first=1, rate=100.0):
        self.machine, self.integers, self.scale = machine, integers, scale
        self.order = ">" if machine == "mips" else "<"
        self.first, self.rate = first, rate
        self.parameters: dict[str, dict[str, object]] = {}

    def add(self, group, name, value):
        """Add a parameter: texts, integers or floats (arrays: the first index runs fastest)."""
        self.parameters.setdefault(group, {})[name] = value
        return self

    def float32(self, values):
        """Return the bytes of 32-bit floats in the machine's format."""
        values = np.asarray(values, float)
        if self.machine != "dec":
            return values.astype(self.order + "f4").tobytes()
        halves = (values * 4.0).astype("<f4").view("<u2").reshape(-1, 2)[:, ::-1]
        return np.ascontiguousarray(halves).tobytes()

    def int16(self, values):
        """Return the bytes of 16-bit integers, signed or unsigned."""
        return np.asarray(values, np.int64).astype(self.order + "u2").tobytes()

    def write(self, path: Path, points, analog=None, samples=10, frames=None):
        """Write a file of points (n, m, 3) and analog words (k, c).

        The header states `frames` as the number of frames; by default the true number.
        """
        count, markers = points.shape[:2]
        channels = 0 if analog is None else analog.shape[1]
        stated = -self.scale if not self.integers else self.scale
        self.add("POINT", "USED", [markers]).add("POINT", "SCALE", np.array([stated]))
        self.add("POINT", "RATE", np.array([self.rate]))
        self.add("ANALOG", "USED", [channels])
        blocks = self._section()
        last = self.first + (count if frames is None else frames) - 1
        start = 2 + len(blocks) // 512
        header = bytes([2, 0x50])
        header += self.int16([markers, channels * samples, self.first, last, 0])
        header += self.float32([stated]) + self.int16([start, samples if channels else 0])
        header += self.float32([self.rate])
        fourth = np.where(np.isfinite(points).all(axis=2), 0.0, -1.0)[:, :, None]
        words = np.concatenate([np.nan_to_num(points), fourth], axis=2).reshape(count, -1)
        if self.integers:
            words.reshape(count, markers, 4)[:, :, :3] /= self.scale
        if channels:
            words = np.concatenate([words, analog.reshape(count, -1)], axis=1)
        data = self.int16(np.rint(words)) if self.integers else self.float32(words.ravel())
        data += bytes(-len(data) % 512)
        path.write_bytes(header.ljust(512, b"\0") + blocks + data)
        return path

    def _section(self):
        """Return the parameter section, filled to whole blocks."""
        records = []
        for number, (group, values) in enumerate(self.parameters.items(), 1):
            records.append((-number, group, b"\0"))
            records += [(number, name, self._value(v) + b"\0") for name, v in values.items()]
        section = b"\1\x50\0" + bytes([MACHINES[self.machine]])
        for number, name, body in records:
            section += struct.pack("bb", len(name), number) + name.encode()
            section += self.int16([len(body) + 2]) + body
        section += b"\0\0"
        section += bytes(-len(section) % 512)
        return section[:2] + bytes([len(section) // 512]) + section[3:]

    def _value(self, value):
        if isinstance(value, list) and value and isinstance(value[0], str):
            width = max(map(len, value))
            texts = "".join(text.ljust(width) for text in value).encode("latin-1")
            return struct.pack("b", -1) + bytes([2, width, len(value)]) + texts
        if isinstance(value, np.ndarray):
            shape = bytes([value.ndim, *value.shape])
            return struct.pack("b", 4) + shape + self.float32(value.ravel(order="F"))
        return struct.pack("b", 2) + bytes([1, len(value)]) + self.int16(value)
