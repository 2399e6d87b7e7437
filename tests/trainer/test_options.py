"""Constructor arguments on the command line, read by their annotations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import pytest

from trainer.configs import UsageError
from trainer.options import options_of, parse, spelled


class Method:
    """A method.

    Args:
        mode: How, in a sentence that goes
            on in a second line.
        names: Which.
        sizes: How large.
    """

    def __init__(
        self,
        mode: Literal["fast", "exact"] = "fast",
        names: Sequence[str] = ("a", "b"),
        sizes: tuple[int, ...] = (),
        *,
        factor: float = 0.5,
        fused: bool | None = None,
        noise: Literal["none", "some"] | Sequence[Literal["none", "some"]] = "none",
        child: object = None,
    ) -> None:
        """Do nothing."""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("mode=exact", "exact"),
        ("names=x, y", ("x", "y")),
        ("names=", ()),
        ("sizes=3,5", (3, 5)),
        ("factor=1e-3", 1e-3),
        ("fused=true", True),
        ("fused=No", False),
        ("fused=none", None),
        ("noise=none", "none"),
        ("noise=none,some", ("none", "some")),
    ],
)
def test_values_are_read_by_their_annotation(text: str, value: Any) -> None:
    assert parse(Method, [text]) == {text.partition("=")[0]: value}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mode=exakt", r"expected fast or exact; did you mean exact\?"),
        ("sizes=3,x", "expected a whole number"),
        ("factor=much", "expected a number"),
        ("fused=2", "expected true or false or none"),
        ("noise=none,much", "expected none or some or words with commas between"),
        ("child=x", "this argument cannot be given on the command line"),
        ("nams=x", r"Method has no option 'nams'; did you mean 'names'\?"),
        ("xyz=1", "Method has no option 'xyz'; it has mode, names"),
        ("mode", "expected KEY=VALUE, such as mode=fast"),
    ],
)
def test_a_wrong_text_is_a_usage_error_that_says_what_was_expected(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=f"^--option {text}: .*{message}"):
        parse(Method, [text])


def test_options_have_defaults_as_they_are_typed_and_the_meaning_of_the_docstring() -> None:
    options = options_of(Method)
    assert options["mode"].meaning == "How, in a sentence that goes on in a second line."
    assert options["names"].shown_default == "a,b"
    assert options["fused"].shown_default == "none"
    assert options["factor"].meaning == ""
    for option in list(options.values())[:3]:
        assert parse(Method, [f"{option.name}={option.shown_default}"]) == {option.name: option.default}


def test_values_are_spelled_as_they_are_read() -> None:
    assert [spelled(v) for v in (True, None, ("x", 1.5), "Word")] == ["true", "none", "x,1.5", "Word"]
