"""What a row of the table of findings holds, and numbers that know their word."""

from dataclasses import dataclass

from gonio.records import Severity


@dataclass(frozen=True)
class Kind:
    """A kind of finding; ``message`` may name ``{where}`` and ``{value}``, a :class:`Number`."""

    severity: Severity
    stage: str
    message: str
    hint: str
    unit: str = ""


class Number(float):
    """A number that can say its word, too: ``f"{Number(1):g picture was|pictures were}"`` is "1 picture was"."""

    def __format__(self, spec: str) -> str:
        one, bar, more = spec.partition("|")
        form, _, word = one.partition(" ")
        return super().__format__(form) + (f" {word if self == 1 else more}" if bar else "")


def counted(count: int, words: str) -> str:
    """Give a count with its word: ``counted(1, "camera|cameras")`` is "1 camera"."""
    return f"{Number(count):g {words}}"
