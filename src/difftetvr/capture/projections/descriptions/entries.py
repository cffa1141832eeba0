"""Entries of a description in JSON: numbers and lists of them, each checked, with one sentence for what is wrong."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from difftetvr.errors import CaptureError, shown
from difftetvr.trust import require_modest, require_regular

_GREATEST = 1e30  # of numbers that mean lengths and angles, so that products of several are numbers
_IN_MEMORY = 10  # times a file's size: what its numbers take as objects of Python


class Entries:
    """What a description says, by name.

    Args:
        values: The description, as JSON gives it.
        source: What it is, for the sentences.

    Raises:
        CaptureError: It is no description.
    """

    def __init__(self, values: Any, source: str) -> None:
        if not isinstance(values, Mapping):
            raise CaptureError(f"{source} is {shown(values)}; give an object with names and values.")
        self.values, self.source = values, source

    def __contains__(self, name: str) -> bool:
        return self.values.get(name) is not None

    def require_known(self, known: Sequence[str]) -> None:
        """Refuses what nobody would read.

        Raises:
            CaptureError: There is an entry of another name.
        """
        for name in self.values:
            if name not in known:
                alike = difflib.get_close_matches(str(name), known, 1)
                hint = f" (is it '{alike[0]}'?); correct it." if alike else f"; known are {', '.join(known)}."
                raise CaptureError(f"{self.source} has an unknown entry {shown(name)}{hint}")

    def text(self, name: str, choices: Sequence[str] = ()) -> str | None:
        """A text; None where there is none.

        Raises:
            CaptureError: It is something else, or none of the choices.
        """
        if name not in self:
            return None
        value = self.values[name]
        if not isinstance(value, str) or (choices and value not in choices):
            self.refuse(name, f"give one of {', '.join(choices)}" if choices else "give a text")
        return value

    def whole(self, name: str) -> int:
        """A whole number of at least 1.

        Raises:
            CaptureError: It is something else, or missing.
        """
        value = self.required(name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            self.refuse(name, "give a whole number of at least 1")
        return int(value)

    def number(self, name: str, default: float | None = None, *, positive: bool = False) -> float:
        """A finite number.

        Raises:
            CaptureError: It is something else, not positive, or missing where there is no default.
        """
        (value,) = self.numbers(name, (1,), None if default is None else (default,), positive=positive).tolist()
        return float(value)

    def numbers(
        self,
        name: str,
        counts: Sequence[int] | None = None,
        default: Sequence[float] | None = None,
        *,
        positive: bool = False,
    ) -> NDArray[np.float64]:
        """(N,) finite numbers; one may stand without brackets.

        Args:
            name: Of the entry.
            counts: How many there may be; None: any number but none.
            default: Where there is no such entry; None: it must be there.
            positive: Whether they must be greater than 0.

        Raises:
            CaptureError: They are something else, or missing.
        """
        if name not in self and default is not None:
            return np.array(default, dtype=np.float64)
        numbers = as_numbers(self.required(name))
        is_fit = numbers is not None and numbers.ndim < 2 and numbers.size > 0
        if is_fit and numbers is not None:
            numbers = numbers.reshape(-1)
            is_fit = (counts is None or len(numbers) in counts) and not (positive and bool((numbers <= 0).any()))
        if not is_fit or numbers is None:
            sort = "numbers greater than 0" if positive else "finite numbers"
            many = " or ".join(map(str, counts)) if counts else "a list of"
            self.refuse(
                name, f"give {many} {sort}" if counts != (1,) else f"give a {sort.replace('numbers', 'number')}"
            )
        return numbers

    def rows(self, name: str, width: int) -> NDArray[np.float64]:
        """(N, width) finite numbers.

        Raises:
            CaptureError: They are something else, or missing.
        """
        numbers = as_numbers(self.required(name))
        if numbers is None or numbers.ndim != 2 or numbers.shape[1] != width or not len(numbers):
            self.refuse(name, f"give a list of rows of {width} finite numbers")
        return numbers

    def required(self, name: str) -> Any:
        """What an entry says.

        Raises:
            CaptureError: There is none.
        """
        if name not in self:
            raise CaptureError(f"{self.source} lacks the entry '{name}'; add it.")
        return self.values[name]

    def refuse(self, name: str, advice: str) -> NoReturn:
        """Says what is wrong with an entry.

        Raises:
            CaptureError: In any case.
        """
        raise CaptureError(f"The entry '{name}' of {in_sentence(self.source)} is {shown(self.values[name])}; {advice}.")


def as_numbers(value: Any) -> NDArray[np.float64] | None:
    """Finite numbers of at most 1e30 as an array; None for all else, truth values and texts among them."""
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "iuf":
            return None
        numbers = raw.astype(np.float64)
    except (ValueError, TypeError, OverflowError):
        return None
    with np.errstate(invalid="ignore"):
        return numbers if bool((np.abs(numbers) <= _GREATEST).all()) else None


def in_sentence(source: str) -> str:
    """The name of a source as it stands within a sentence."""
    return source[0].lower() + source[1:] if source.startswith(("The ", "A ")) else source


def read_json(path: Path, what: str) -> Any:
    """A file's content.

    Args:
        path: The file.
        what: What it should hold, for the sentence.

    Raises:
        CaptureError: There is none, it cannot be read, or is no JSON.
    """
    require_regular(path, CaptureError)
    try:
        require_modest(path, _IN_MEMORY * path.stat().st_size, "text", CaptureError)
        return parse_json(path.read_bytes(), f"'{path}'")
    except FileNotFoundError:
        raise CaptureError(f"There is no file '{path}'; check the path of the {what}.") from None
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}; check its permissions.") from error


def parse_json(text: str | bytes, source: str) -> Any:
    """What a text in JSON says.

    Raises:
        CaptureError: It is none.
    """
    try:
        return json.loads(text, parse_constant=lambda _: math.nan)
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{source} is no JSON ({str(error).rstrip('.')[:100]}); correct it.") from error
