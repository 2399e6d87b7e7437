"""What a checkpoint would make, told from its archive before PyTorch makes it.

`torch.load(weights_only=True)` calls only functions that it knows, but those may ask for any amount of
memory: `bytearray(10**12)`, a tensor that is larger than its storage, a record that unpacks to gigabytes, or
a key of nested tuples whose hash takes years. So a checkpoint may hold what those of `trainer fit` and of the
published methods hold and nothing else: plain values, and tensors whose bytes are in the file.
"""

from __future__ import annotations

import math
import pickletools
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

_ITEM = {"Double": 8, "Float": 4, "Half": 2, "BFloat16": 2, "Long": 8, "Int": 4, "Short": 2, "Char": 1,
         "Byte": 1, "Bool": 1}  # fmt: skip
_STORAGE = re.compile(rf"torch ({'|'.join(_ITEM)})Storage")
_PLAIN = re.compile(r"torch (float|bfloat|int|uint|bool|complex)\d*")
_ORDERED, _TENSOR = "collections OrderedDict", "torch._utils _rebuild_tensor_v2"
_CALLED = (_ORDERED, _TENSOR, "torch._utils _rebuild_parameter", "torch Size", "torch device", "builtins set",
           "__builtin__ set")  # fmt: skip
_MEMBERS = 1 << 17
_SPARE = 1 << 20
_TUPLE = 1 << 14
_DEPTH = 16


class ForeignObject(ValueError):  # noqa: N818  # says what is there
    """A checkpoint holds objects beside tensors and plain values."""


class _Name(NamedTuple):
    text: str


class _Storage(NamedTuple):
    length: int
    item: int


class _Tuple(NamedTuple):
    items: list[Any]
    weight: int
    depth: int


class _Thing(NamedTuple):
    """A dictionary, list or tensor, which need not be known."""

    made_by: str = ""


def check_archive(path: Path) -> None:
    """Refuse a file of `torch.save` that holds more than plain values and tensors, or less than it claims.

    Raises:
        ForeignObject: It holds other objects.
        ValueError: It is no such file, or is damaged.
        OSError: It cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = member_sizes(archive, path.stat().st_size)
            name = next((name for name in members if name.endswith("/data.pkl")), None)
            if name is None:
                raise ValueError("its archive has no data.pkl")
            folder = name.removesuffix("data.pkl")
            sizes = {n.removeprefix(folder): size for n, size in members.items() if n.startswith(folder)}
            _Outline(sizes).follow(archive.read(name))
    except (
        zipfile.BadZipFile,
        NotImplementedError,
        EOFError,
        RuntimeError,
        OverflowError,
        struct.error,
    ) as error:
        raise ValueError(str(error) or "its archive is damaged") from error


def member_sizes(archive: zipfile.ZipFile, size: int, ratio: int = 1) -> dict[str, int]:
    """Return the bytes of each member of an archive that claims no more than it has.

    Args:
        archive: The archive.
        size: Bytes of its file.
        ratio: How much larger its members may be when they are unpacked; 1: none is compressed.

    Raises:
        ValueError: It claims more, or names members twice.
    """
    members = archive.infolist()
    sizes = {member.filename: member.file_size for member in members}
    if len(sizes) < len(members) or len(members) > _MEMBERS:
        raise ValueError("its archive has members of one name, or too many")
    stored = [member for member in members if member.compress_type == zipfile.ZIP_STORED]
    if ratio == 1 and len(stored) < len(members):
        raise ValueError("members of its archive are compressed")
    packed = sum(member.compress_size for member in members)
    wrong = any(member.compress_size != member.file_size for member in stored)
    wrong = wrong or any(not 0 <= member.header_offset < size for member in members)
    if wrong or packed > size or sum(sizes.values()) > ratio * size:
        raise ValueError("members of its archive claim more bytes than it has")
    return sizes


class _Outline:
    """Follows the opcodes of a pickle without making anything.

    Args:
        sizes: Bytes of each member of the archive.
    """

    def __init__(self, sizes: dict[str, int]) -> None:
        self.sizes = sizes
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def follow(self, data: bytes) -> None:
        """Raise a ValueError unless the pickle makes plain values and tensors that the archive holds."""
        try:
            for opcode, argument, _ in pickletools.genops(data):
                step: Callable[[Any], None] | None = getattr(self, f"_{opcode.name.lower()}", None)
                if step is not None:
                    step(argument)
                elif opcode.name in _VALUES:
                    self.stack.append(_VALUES[opcode.name](argument))
                elif opcode.name in _TAKEN:
                    self._take(_TAKEN[opcode.name])
                else:
                    raise ForeignObject(f"opcode {opcode.name}")
        except (IndexError, KeyError, TypeError, AttributeError) as error:
            raise ValueError("its pickle is damaged") from error

    def _take(self, count: int | None) -> list[Any]:
        """Return the last entries of the stack, those behind the last mark for None."""
        start = self.marks.pop() if count is None else len(self.stack) - count
        if start < 0:
            raise IndexError
        taken = self.stack[start:]
        del self.stack[start:]
        return taken

    def _mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def _binput(self, number: int) -> None:
        self.memo[number] = self.stack[-1]

    _long_binput = _binput

    def _binget(self, number: int) -> None:
        self.stack.append(self.memo[number])

    _long_binget = _binget

    def _global(self, name: str) -> None:
        if name not in _CALLED and not _STORAGE.fullmatch(name) and not _PLAIN.fullmatch(name):
            raise ForeignObject(name.replace(" ", "."))
        self.stack.append(_Name(name))

    def _tuple(self, _: None) -> None:
        self._push_tuple(self._take(None))

    def _tuple1(self, _: None) -> None:
        self._push_tuple(self._take(1))

    def _tuple2(self, _: None) -> None:
        self._push_tuple(self._take(2))

    def _tuple3(self, _: None) -> None:
        self._push_tuple(self._take(3))

    def _push_tuple(self, items: list[Any]) -> None:
        inner = [item for item in items if isinstance(item, _Tuple)]
        weight = len(items) + 1 + sum(item.weight for item in inner)
        depth = 1 + max((item.depth for item in inner), default=0)
        if weight > _TUPLE or depth > _DEPTH:
            raise ValueError("it holds a tuple of too many values")
        self.stack.append(_Tuple(items, weight, depth))

    def _binpersid(self, _: None) -> None:
        word, kind, key, _place, count = self.stack.pop().items
        found = _STORAGE.fullmatch(kind.text)
        if word != "storage" or found is None:
            raise ValueError("its pickle is damaged")
        item = _ITEM[found[1]]
        if self.sizes.get(f"data/{key}") != _number(count) * item:
            raise ValueError(f"its tensors claim other bytes than data/{str(key)[:20]} has")
        self.stack.append(_Storage(count, item))

    def _reduce(self, _: None) -> None:
        function, arguments = self._take(2)
        if function.text not in _CALLED:
            raise ForeignObject(function.text.replace(" ", "."))
        if function.text == _TENSOR:
            _check_tensor(*arguments.items[:4])
        self.stack.append(_Thing(function.text))

    def _build(self, _: None) -> None:
        target, _state = self._take(2)
        if target != _Thing(_ORDERED):
            raise ForeignObject("an object with a state")
        self.stack.append(target)


_VALUES: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE"), lambda value: value),
    **dict.fromkeys(("EMPTY_DICT", "EMPTY_LIST", "EMPTY_SET", "SHORT_BINSTRING"), lambda _: _Thing()),
    "NONE": lambda _: None,
    "NEWFALSE": lambda _: False,
    "NEWTRUE": lambda _: True,
    "EMPTY_TUPLE": lambda _: _Tuple([], 1, 1),
}
_TAKEN = {"PROTO": 0, "STOP": 1, "APPEND": 1, "APPENDS": None, "SETITEM": 2, "SETITEMS": None}


def _number(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 1 << 62:
        raise ValueError("a size in its pickle is no number")
    return value


def _check_tensor(storage: _Storage, offset: Any, size: _Tuple, stride: _Tuple) -> None:
    """Refuse a tensor that reaches out of its storage, or repeats it to something large."""
    sizes, strides = list(map(_number, size.items)), list(map(_number, stride.items))
    if len(sizes) != len(strides) or not isinstance(storage, _Storage):
        raise ValueError("its pickle is damaged")
    count = math.prod(sizes)
    last = _number(offset) + sum((n - 1) * step for n, step in zip(sizes, strides, strict=True))
    if (count and last >= storage.length) or count * storage.item > storage.length * storage.item + _SPARE:
        raise ValueError("a tensor is larger than what is stored of it")
