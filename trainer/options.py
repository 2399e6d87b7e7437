"""`--option KEY=VALUE`: arguments of a method's constructor, read by what its signature says.

Names, types and defaults come from the signature, the sentences from the `Args` of the class's docstring, so
that a method outside of Penumbra has options without doing anything for it.
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import re
import types
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from trainer.configs import UsageError

_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
_SIMPLE = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}


class AddModel(argparse.Action):
    """`--model`, which may be repeated: begins a pair of a model and the list of its options."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        """Append the pair to the value."""
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), (values, [])])


class AddOption(argparse.Action):
    """`--option`, with the same `dest`: belongs to the model before it."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        """Append the option to those of the last model."""
        if not getattr(namespace, self.dest):
            raise argparse.ArgumentError(self, f"{values}: expected after the --model that it is for")
        getattr(namespace, self.dest)[-1][1].append(values)


@dataclass(frozen=True)
class Option:
    """One argument of a constructor.

    Attributes:
        name: Its name.
        kind: Its annotation.
        default: Its default value, `inspect.Parameter.empty` where it has none.
        meaning: What the docstring says about it, in one line.
    """

    name: str
    kind: Any
    default: Any
    meaning: str

    @property
    def expected(self) -> str:
        """What a value may be, such as `public or paper`, `a whole number`."""
        return _expected(self.kind)

    @property
    def shown_default(self) -> str:
        """The default as it would be typed."""
        if self.default is inspect.Parameter.empty:
            return ""
        return spelled(self.default)


def spelled(value: Any) -> str:
    """Return a value as it is typed after `KEY=`."""
    if isinstance(value, (list, tuple)):
        return ",".join(spelled(item) for item in value)
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)


def options_of(cls: type) -> dict[str, Option]:
    """Return the options of a class in the order of its signature."""
    parameters = inspect.signature(cls).parameters.values()
    hints = get_type_hints(cls.__init__)  # type: ignore[misc]
    meanings = _meanings(cls)
    return {
        p.name: Option(p.name, hints.get(p.name, str), p.default, meanings.get(p.name, ""))
        for p in parameters
        if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }


def parse(cls: type, given: Sequence[str]) -> dict[str, Any]:
    """Return constructor arguments from texts `KEY=VALUE`.

    Args:
        cls: Whose constructor.
        given: The texts; lists are separated by commas, `KEY=` is an empty one.

    Raises:
        UsageError: A text has no `=`, an option is unknown or given twice, or a value is of the wrong type.
    """
    known, found = options_of(cls), {}
    for text in given:
        name, equals, value = text.partition("=")
        name = name.strip().replace("-", "_")
        if not equals:
            raise UsageError(f"--option {text}: expected KEY=VALUE, such as {_example(known)}")
        if name not in known:
            raise UsageError(f"--option {text}: {cls.__name__} has no option {name!r}; {_hint(name, cls)}")
        if name in found:
            raise UsageError(f"--option {text}: {name} is given twice")
        try:
            found[name] = _read(value.strip(), known[name].kind)
        except ValueError as error:
            raise UsageError(f"--option {text}: {error}") from None
    return found


def _hint(name: str, cls: type) -> str:
    known = list(options_of(cls))
    if not known:
        return "it has none"
    near = difflib.get_close_matches(name, known, n=1)
    listed = f"`trainer models {cls.__name__}` lists them"
    return f"did you mean {near[0]!r}? {listed}" if near else f"it has {', '.join(known)}; {listed}"


def _example(known: dict[str, Option]) -> str:
    return next((f"{o.name}={o.shown_default}" for o in known.values() if o.shown_default), "window=9")


def _read(text: str, kind: Any) -> Any:
    """Return the value that a text means where this type is expected.

    Raises:
        ValueError: It means none; the message says what was expected.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        named = {spelled(value): value for value in parts}
        if text in named:
            return named[text]
        near = difflib.get_close_matches(text, named, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(f"expected {_expected(kind)}{hint}")
    if origin in (Union, types.UnionType):
        return _first(text, kind, parts)
    if kind is type(None):
        if text.lower() == "none":
            return None
        raise ValueError("expected none")
    if _is_list(kind):
        inner = parts[0] if parts else str
        return tuple(_read(item.strip(), inner) for item in text.split(",")) if text else ()
    return _plain(text, kind)


def _first(text: str, kind: Any, parts: tuple[Any, ...]) -> Any:
    """Return the value for the first type of a union that takes the text; words come last."""
    for part in sorted(parts, key=lambda p: p is str):
        try:
            return _read(text, part)
        except ValueError:
            continue
    raise ValueError(f"expected {_expected(kind)}")


def _plain(text: str, kind: Any) -> Any:
    if kind is bool and text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if kind in (int, float):
        try:
            return kind(text.replace("_", "") if kind is int else text)
        except ValueError:
            pass
    if kind is str:
        return text
    if kind not in _SIMPLE:
        raise ValueError("this argument cannot be given on the command line")
    raise ValueError(f"expected {_expected(kind)}")


def _is_list(kind: Any) -> bool:
    origin = get_origin(kind) or kind
    return isinstance(origin, type) and issubclass(origin, Sequence) and origin is not str


def _expected(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return _either([spelled(value) for value in parts])
    if origin in (Union, types.UnionType):
        return _either([_expected(part) for part in parts])
    if kind is type(None):
        return "none"
    if _is_list(kind):
        inner = {int: "whole numbers", float: "numbers"}.get(parts[0] if parts else str, "words")
        return f"{inner} with commas between"
    return _SIMPLE.get(kind, getattr(kind, "__name__", str(kind)))


def _either(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def _meanings(cls: type) -> dict[str, str]:
    """Return what the `Args` of the docstrings say, those of a class before those of its bases."""
    found: dict[str, str] = {}
    for base in cls.__mro__:
        if base is object or base.__module__.startswith("torch"):
            continue
        for text in (vars(base).get("__doc__"), getattr(vars(base).get("__init__"), "__doc__", None)):
            for name, meaning in _arguments(inspect.cleandoc(text or "")):
                found.setdefault(name, meaning)
    return found


def _arguments(doc: str) -> list[tuple[str, str]]:
    """Return names and sentences of the section `Args` of a docstring in Google's style."""
    _, _, section = doc.partition("\nArgs:\n")
    section = re.split(r"\n(?=\S)", section, maxsplit=1)[0]
    entries = re.split(r"\n? {4}(?=\w+(?: \(.*?\))?: )", "\n" + section)
    pairs = (entry.partition(":")[::2] for entry in entries if ":" in entry)
    return [(name.split(" ")[0].strip(), " ".join(text.split())) for name, text in pairs]
