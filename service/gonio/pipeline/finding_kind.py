"""What a row of the table of findings holds."""

from dataclasses import dataclass

from gonio.records import Severity


@dataclass(frozen=True)
class Kind:
    """A kind of finding; ``message`` may name ``{where}`` and ``{value}``."""

    severity: Severity
    stage: str
    message: str
    hint: str
    unit: str = ""
