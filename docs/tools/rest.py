"""The page of the REST API, made from its OpenAPI document."""

from collections import Counter
from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Any

Document = Mapping[str, Any]
METHODS = ("get", "head", "post", "patch", "delete", "options")
HEAD = [
    "# REST reference",
    "",
    "Made by `make reference` from [openapi.json](openapi.json), which is what the service itself says under `/openapi.json`.",
    "A running service shows the same under `/docs`, where requests can be tried.",
    "",
    "Send a key as `Authorization: Bearer KEY` where the service wants one ([keys](../howto/serve-a-lab.md#keys)). Every",
    "answer that is no success is a problem document (`application/problem+json`) with a `code`, a `detail` and a `hint`.",
    "",
]


def rest_page(document: Document) -> str:
    """Give the page: what all answers share, each operation by its tag, each schema."""
    operations = [
        (method, path, item[method]) for path, item in document["paths"].items() for method in METHODS if method in item
    ]
    counts = Counter(pair for _, _, operation in operations for pair in _problems(operation))
    shared = {pair for pair, count in counts.items() if count > len(operations) / 2}
    lines = [*HEAD, "## Problems that any request may meet", "", *_problem_table(shared)]
    for tag in dict.fromkeys(operation["tags"][0] for _, _, operation in operations):
        lines += [f"## {tag.capitalize()}", ""]
        for method, path, operation in operations:
            if operation["tags"][0] == tag:
                lines += _operation(method, path, operation, shared)
    lines += ["## Schemas", ""]
    for name, schema in document["components"]["schemas"].items():
        if not name.startswith("ListOf_"):
            lines += [f"### {name}", "", *_description(schema), *_properties(schema)]
    return "\n".join(lines)


def parameters_page(analysis: Document, calibration: Document) -> str:
    """Give the page of what an analysis and a calibration may be asked for."""
    lines = [
        "# Parameters",
        "",
        "What a request may choose; whatever it leaves out has its default. They are sent as `parameters` of an analysis,",
        "or written into a JSON file for `--parameters`. Made by `make reference` from `gonio/pipeline/params.py`.",
        "",
        "```json",
        '{"subject": {"mass_kg": 61}, "keypoints": {"rate": "exact"}}',
        "```",
        "",
    ]
    for group, about in analysis["properties"].items():
        schema = analysis["$defs"][about["$ref"].rpartition("/")[2]]
        lines += [f"## `{group}`", "", *_description(schema), *_properties(schema)]
    lines += ["## Of a calibration", "", *_description(calibration), *_properties(calibration)]
    for name, schema in calibration.get("$defs", {}).items():
        lines += [f"### {name}", "", *_description(schema), *_properties(schema)]
    return "\n".join(lines)


def _operation(method: str, path: str, operation: Document, shared: set[tuple[str, str, str]]) -> list[str]:
    lines = [f"### `{method.upper()} {path}`", "", *_description(operation)]
    if rows := [
        _row(p["name"], p["schema"], p.get("description", ""), p["in"]) for p in operation.get("parameters", ())
    ]:
        lines += ["| parameter | in | type | meaning |", "|---|---|---|---|", *rows, ""]
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        schema = content.get("schema", {})
        lines += [f"*Body* (`{kind}`): {_type(schema)}", "", *_properties(schema)]
    for status, answer in operation["responses"].items():
        if status < "400":
            schemas = [c.get("schema", {}) for c in answer.get("content", {}).values()]
            types = " or ".join(dict.fromkeys(_type(schema) for schema in schemas if schema))
            kinds = ", ".join(f"`{kind}`" for kind in answer.get("content", {}))
            words = (f"*{status}*", _sentence(answer["description"]), types or kinds)
            lines += [" ".join(filter(None, words)), ""]
    if own := _problems(operation) - shared:
        lines += _problem_table(own)
    return lines


def _problems(operation: Document) -> set[tuple[str, str, str]]:
    """Give the problems of an operation: status, code, meaning."""
    found: set[tuple[str, str, str]] = set()
    for status, answer in operation["responses"].items():
        if status >= "400":
            for line in answer["description"].splitlines():
                code, _, meaning = line.removeprefix("* ").partition(": ")
                found.add((status, code, meaning) if meaning else (status, "", line))
    return found


def _problem_table(problems: Iterable[tuple[str, str, str]]) -> list[str]:
    rows = [f"| {status} | {code} | {_cell(meaning)} |" for status, code, meaning in sorted(problems)]
    return ["| status | code | meaning |", "|---|---|---|", *rows, ""]


def _properties(schema: Document) -> list[str]:
    if "properties" not in schema:
        values = schema.get("enum", ())
        return [f"One of {', '.join(f'`{value}`' for value in values)}.", ""] if values else []
    needed = schema.get("required", ())
    rows = [
        _row(name, about, _meaning(about), "yes" if name in needed else _default(about))
        for name, about in schema["properties"].items()
    ]
    return ["| member | needed | type | meaning |", "|---|---|---|---|", *rows, ""]


def _meaning(about: Document) -> str:
    """Give what a schema, or the choice of it that says something, means."""
    return next((a["description"] for a in (about, *about.get("anyOf", ())) if "description" in a), "")


def _default(about: Document) -> str:
    value = about.get("default")
    return (
        "" if value in (None, "", {}, []) else f"default `{str(value).lower() if isinstance(value, bool) else value}`"
    )


def _row(name: str, schema: Document, meaning: str, middle: str) -> str:
    return f"| `{name}` | {middle} | {_type(schema)} | {_cell(meaning)} |"


def _type(schema: Document) -> str:
    """Name the type of a schema, with a link to those that have a place on the page."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        inner = name.removeprefix("ListOf_").removesuffix("_")
        link = f"[{inner}](#{inner.lower()})"
        return f"page of {link}" if name.startswith("ListOf_") else link
    if choices := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(dict.fromkeys(_type(choice) for choice in choices))
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    if schema.get("type") == "array":
        members = schema.get("prefixItems")
        return f"{len(members)} of {_type(members[0])}" if members else f"list of {_type(schema.get('items', {}))}"
    name = schema.get("format", schema.get("type", "anything"))
    return f"{name}{_limits(schema)}"


def _limits(schema: Document) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    limits = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    limits += [f"at most {schema[key]} characters" for key in ("maxLength",) if key in schema]
    return f" ({', '.join(limits)})" if limits else ""


def _description(about: Document) -> list[str]:
    text = about.get("description", "").strip()
    return [*text.splitlines(), ""] if text else []


def _sentence(text: str) -> str:
    known = {status.phrase: "" for status in HTTPStatus}
    return known.get(text, text if text.endswith(".") else f"{text}.")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
