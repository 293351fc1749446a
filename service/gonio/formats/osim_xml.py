"""OpenSim's XML: opened safely, its properties read with their defaults, and errors that name the element.

OpenSim leaves out properties that are at their default, and repeats in comments what each one means; a property is a
child element with text. Everything here takes an element and the property's tag.
"""

import math
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - no types

from gonio.errors import InputError

Element: TypeAlias = Any
"""An lxml element; lxml ships no types."""

OLDEST, NEWEST = 10000, 40699
"""The document versions that OpenSim 1.x to 4.6 write."""

_LARGEST_BYTES = 64 << 20  # the largest published model, with all its muscles, has 5 MB


def open_document(path: Path, expected: str, *, keep_comments: bool = False) -> tuple[Element, int]:
    """Open an OpenSim document.

    Args:
        path: The file.
        expected: The element that it must hold, such as ``Model``.
        keep_comments: Keep OpenSim's explanations, for a document that is written again.

    Returns:
        The expected element and the document's version (10905, 20303, 40000, …).

    Raises:
        InputError: no such file, not XML, cut short, with a document type or entities, no OpenSim document, or without
            the expected element.
    """
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        remove_comments=not keep_comments,
        remove_pis=True,
    )
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(
                f"{path.name} is too large for an OpenSim file.", hint="Give the .osim or setup file itself."
            )
        document = etree.fromstring(path.read_bytes(), parser)
    except OSError as error:
        raise InputError(f"{path.name} can't be read: {error.strerror}.", hint="Check the path.") from error
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(
            f"{path.name} is not well-formed XML: {error}.", hint="Was it cut short? Export it from OpenSim again."
        ) from error
    if document.getroottree().docinfo.doctype:
        raise InputError(f"{path.name} declares a document type.", hint="OpenSim files have none; remove the DOCTYPE.")
    found = document if document.tag == expected else document.find(expected)
    if document.tag not in ("OpenSimDocument", expected) or found is None:
        raise InputError(
            f"{path.name} holds no {expected}: its root is {document.tag}.",
            hint=f"Give an OpenSim file with <OpenSimDocument><{expected}>.",
        )
    return found, _version(document, path)


def _version(document: Element, path: Path) -> int:
    """Read the version; a file without the envelope is of OpenSim 1.x."""
    given = document.get("Version", "10905") if document.tag == "OpenSimDocument" else "10905"
    version = int(given) if given.isascii() and given.isdigit() and len(given) < 10 else -1
    if not OLDEST <= version <= NEWEST:
        raise InputError(
            f"{path.name} has the document version {given!r}.",
            hint=f"gonio reads {OLDEST} to {NEWEST} (OpenSim 1.x to 4.6); save the file with one of these.",
        )
    return version


def name_of(element: Element) -> str:
    """Give the element's name, or its tag where it has none."""
    return element.get("name", "").strip() or str(element.tag)


def describe(element: Element) -> str:
    """Name an element for an error message: what it is, its name and its line."""
    label = element.get("name", "").strip()
    line = f" (line {element.sourceline})" if element.sourceline else ""
    return f"{element.tag} {label}{line}" if label else f"{element.tag}{line}"


def text(element: Element, tag: str, default: str = "") -> str:
    """Read a property as text without the white space around it."""
    found = element.find(tag)
    if found is None or found.text is None:
        return default
    return found.text.strip() or default


def words(element: Element, tag: str) -> list[str]:
    """Read a property that lists names, separated by white space."""
    return text(element, tag).split()


def numbers(element: Element, tag: str) -> Float[np.ndarray, " number"]:
    """Read a property that lists finite numbers; an absent one is empty."""
    given = words(element, tag)
    try:
        values = [float(word) for word in given]
    except ValueError as error:
        raise InputError(
            f"<{tag}> of {describe(element)} holds {' '.join(given)[:60]!r}, which are not numbers.",
            hint="Write plain numbers separated by spaces.",
        ) from error
    if not all(map(math.isfinite, values)):
        raise InputError(
            f"<{tag}> of {describe(element)} holds a number that is not finite.", hint="Give it a finite value."
        )
    return np.array(values, dtype=float)


def vector(element: Element, tag: str, default: tuple[float, ...]) -> Float[np.ndarray, " component"]:
    """Read a property of as many numbers as its default has."""
    values = numbers(element, tag)
    if len(values) == 0:
        return np.array(default, dtype=float)
    if len(values) != len(default):
        raise InputError(
            f"<{tag}> of {describe(element)} holds {len(values)} numbers.", hint=f"It must hold {len(default)}."
        )
    return values


def number(element: Element, tag: str, default: float) -> float:
    """Read a property of one number."""
    return float(vector(element, tag, (default,))[0])


def flag(element: Element, tag: str, *, default: bool) -> bool:
    """Read a property that is true or false."""
    given = text(element, tag).lower()
    if given not in ("", "true", "false", "1", "0"):
        raise InputError(f"<{tag}> of {describe(element)} is {given[:40]!r}.", hint="It must be true or false.")
    return default if given == "" else given in ("true", "1")


def children(element: Element | None) -> list[Element]:
    """List an element's child elements, without comments; an absent element has none."""
    return [] if element is None else list(element.iterchildren("*"))


def objects(owner: Element, tag: str) -> list[Element]:
    """List the elements of a set, ``<tag><objects>…``; an absent set is empty."""
    return children(owner.find(f"{tag}/objects"))


def assigned(element: Element, tag: str) -> str:
    """Read a property as text; what OpenSim calls unassigned is empty."""
    given = text(element, tag)
    return "" if given == "Unassigned" else given


def optional_file(element: Element, tag: str, document: Path) -> Path | None:
    """Read a property that names a file relative to the document's folder; None where it names none."""
    given = assigned(element, tag)
    return document.parent / given if given else None


def required_file(element: Element, tag: str, document: Path) -> Path:
    """Read a property that must name a file, relative to the document's folder."""
    found = optional_file(element, tag, document)
    if found is None:
        raise InputError(f"{document.name} has no <{tag}>.", hint="Name the file, relative to the setup's folder.")
    return found
