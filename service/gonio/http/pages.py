"""The pages for people, rendered here from small templates; they carry their style in themselves and run nothing."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

_ENVIRONMENT = Environment(
    loader=PackageLoader("gonio.http"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)


def _marked(text: str) -> Markup:
    """Show the little Markdown that the API's descriptions have: `code`, and lists of `* ` lines."""
    lines = [
        re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(line.removeprefix("* ")))) for line in text.splitlines()
    ]
    return Markup("<br>").join(Markup(line) for line in lines)  # noqa: S704 - each line was escaped


_ENVIRONMENT.filters["marked"] = _marked


def render(template: str, **values: object) -> str:
    """Render a page."""
    return _ENVIRONMENT.get_template(template).render(values)


class Operation(NamedTuple):
    """One entry of the reference: a method of an address."""

    tag: str
    method: str
    path: str
    summary: str
    description: str
    parameters: list[dict[str, Any]]
    body: Mapping[str, Any] | None
    body_type: str
    example: Any
    responses: Mapping[str, Mapping[str, Any]]


def operations(document: Mapping[str, Any]) -> Iterator[Operation]:
    """Give the operations of an OpenAPI document in its order, with references resolved as far as a reader needs."""
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            content: Mapping[str, Any] = operation.get("requestBody", {}).get("content", {})
            body_type = next(iter(content), "")
            schema = _resolve(document, content[body_type]["schema"]) if content else None
            yield Operation(
                tag=operation.get("tags", [""])[0],
                method=method.upper(),
                path=path,
                summary=operation.get("summary", ""),
                description=operation.get("description", ""),
                parameters=operation.get("parameters", []),
                body=schema,
                body_type=body_type,
                example=(schema or {}).get("example"),
                responses=operation["responses"],
            )


def _resolve(document: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Follow a reference, also the one of an optional body."""
    for choice in schema.get("anyOf", []):
        if "$ref" in choice:
            schema = choice
    if "$ref" not in schema:
        return schema
    return document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
