"""Stored rows of a study, which can therefore be stopped and resumed.

Each row is stored at once as a line of JSON, {"key": ..., "row": ..., "sha256": ...}. "key" is the
SHA-256 of the measured case and the code, "sha256" that of key and row. An incomplete or changed
line counts as absent.
"""

import hashlib
import json
import threading
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from tkamb import code_identity
from tkamb.errors import InputError
from tkamb.files import TABLE_BYTES, read_bytes, undamaged, write_text

FILE_NAME = "rows.jsonl"

Row = dict[str, Any]
T = TypeVar("T")


class KeptRows:
    """The stored rows in the folder of a study.

    Args:
        resume: whether to use an earlier study's rows in the folder, or delete them.
    """

    def __init__(self, directory: Path, resume: bool) -> None:
        self.path = directory / FILE_NAME
        self._rows = _whole_rows(self.path) if resume else {}
        self._lock, self._before_next = threading.Lock(), ""
        write_text(self.path, "".join(_line(key, row) for key, row in self._rows.items()))

    def get(self, key: str) -> Row | None:
        """Return the row with a key, or None."""
        return self._rows.get(key)

    def read(self, key: str, kind: type[T]) -> T | None:
        """Return the row with a key as an object, or None."""
        if key not in self._rows:
            return None
        with undamaged(self.path, "remove the file, or leave out resume=True"):
            return TypeAdapter(kind).validate_json(json.dumps(self._rows[key]))

    def put(self, key: str, row: Row) -> None:
        """Store a row under its key."""
        with self._lock:
            self._rows[key] = row
            try:
                with open(self.path, "a", encoding="utf-8") as file:
                    file.write(self._before_next + _line(key, row))
                self._before_next = ""
            except OSError as error:
                self._before_next = "\n"  # a full disk may have cut this line short
                raise InputError(f"cannot be written ({error.strerror})", self.path) from None


def _line(key: str, row: Row) -> str:
    return json.dumps({"key": key, "row": row, "sha256": _row_hash(key, row)}) + "\n"


def _row_hash(key: str, row: Row) -> str:
    return hashlib.sha256(json.dumps([key, row], sort_keys=True).encode()).hexdigest()


def _whole_rows(path: Path) -> dict[str, Row]:
    result: dict[str, Row] = {}
    content = read_bytes(path, TABLE_BYTES) if path.exists() else b""
    for line in content.decode(errors="replace").splitlines():
        try:
            one = json.loads(line)
            if one["sha256"] == _row_hash(one["key"], one["row"]):
                result[one["key"]] = one["row"]
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return result


def row_key(*what: Any) -> str:
    """Return the key of a row: the SHA-256 of the code and of `what`, the measured case."""
    text = json.dumps([code_identity(), *what], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
