"""The decorator that every record uses: frozen, slots, keyword-only, shapes checked, arrays read-only."""

from dataclasses import dataclass, fields
from typing import Any, TypeVar, dataclass_transform

import numpy as np
from beartype import beartype
from jaxtyping import jaxtyped

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False)
def record(cls: type[T]) -> type[T]:
    """Make a class a record: a frozen dataclass whose array shapes are checked when it is constructed.

    A shape name that two fields share (``frame``, ``keypoint``) must have one length, or construction fails with the
    field and both shapes. Arrays are copied and made read-only, so neither the caller's array nor the record can change
    behind the other's back; one that is read-only already and owns its memory is kept as it is, so that records of a long
    trial share what they have in common. There is no ``==``: comparing arrays needs a tolerance (``eq=False``).
    """
    validate = cls.__dict__.get("__post_init__")

    def __post_init__(self: Any) -> None:  # noqa: ANN401 - any record
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray) and (value.flags.writeable or not value.flags.owndata):
                own = value.copy()
                own.setflags(write=False)
                object.__setattr__(self, field.name, own)
        if validate is not None:
            validate(self)

    cls.__post_init__ = __post_init__  # type: ignore[attr-defined] - the dataclass calls it
    return jaxtyped(typechecker=beartype)(dataclass(frozen=True, slots=True, kw_only=True, eq=False)(cls))
