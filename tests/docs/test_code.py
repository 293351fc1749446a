"""What the pages tell people to type: Python is run, commands are parsed, addresses, settings and files are looked up.

A Python block that can't run here carries the reason in a comment before it: ``<!-- not run: … -->``.
"""

import hashlib
import hmac
import json
import re
import shlex
import subprocess
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest
import typer.main

from gonio.bench import list_benches
from gonio.cli import app
from gonio.formats.articulated import read_body_card
from gonio.formats.pressure_card import read_pressure_card
from gonio.pipeline.params import CalibrationParameters, parse_calibration_parameters, parse_parameters
from gonio.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
FENCE = re.compile(
    r"(?:<!-- not run: (?P<reason>[^>]+) -->\n+)?^(?P<indent> *)```(?P<language>[a-z]*)\n(?P<code>.*?)^ *```",
    re.DOTALL | re.MULTILINE,
)
SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
BODY = b'{"event": "job-ended"}'


class Block(NamedTuple):
    """A block of code: where it stands, its language, why it is not run."""

    page: Path
    line: int
    language: str
    code: str
    reason: str | None


def blocks(*languages: str) -> list[Block]:
    """All blocks of the pages in these languages."""
    found = []
    for page in PAGES:
        text = page.read_text()
        for match in FENCE.finditer(text):
            if match["language"] in languages:
                code = re.sub(rf"^{match['indent']}", "", match["code"], flags=re.MULTILINE)
                found.append(Block(page, text.count("\n", 0, match.end()), match["language"], code, match["reason"]))
    return found


def name(block: Block) -> str:
    return f"{block.page.relative_to(ROOT)}:{block.line}"


def spans() -> Iterator[tuple[Path, str]]:
    """All code within sentences, and the lines of indented blocks."""
    for page in PAGES:
        text = FENCE.sub("", page.read_text())
        for code in [*SPAN.findall(text), *re.findall(r"^ {4,}(\S.*)$", text, re.MULTILINE)]:
            yield page, code


def given() -> dict[str, Any]:
    """What a block may take as known: a webhook's message as the service signs it."""
    now = int(time.time())
    digest = hmac.new(b"secret", f"{now}.".encode() + BODY, hashlib.sha256).hexdigest()
    signed = {"Gonio-Signature": f"t={now},v1={digest}"}
    return {"hashlib": hashlib, "hmac": hmac, "time": time, "secret": "secret", "body": BODY, "headers": signed}


@pytest.mark.parametrize("block", blocks("python"), ids=name)
def test_python_runs(block: Block) -> None:
    code = compile(block.code, name(block), "exec")
    if block.reason:
        pytest.skip(block.reason)
    exec(code, given())


@pytest.mark.parametrize("block", blocks("sh"), ids=name)
def test_shell_is_shell(block: Block) -> None:
    checked = subprocess.run(["bash", "-n"], input=block.code, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr


def commands(code: str) -> Iterator[list[str]]:
    """The calls of ``gonio`` in a piece of shell."""
    for line in code.replace("\\\n", " ").splitlines():
        if match := re.search(r"(?:^|[;&|(] *|\bdo )(gonio [^;&|]*)", line.strip()):
            yield shlex.split(match[1], comments=True)[1:]


def parse(arguments: list[str]) -> None:
    """Let the command line parse a call, down to its options and their types, without running it."""
    command: click.Command = typer.main.get_command(app)
    path = ["gonio"]
    while isinstance(command, click.Group) or hasattr(command, "commands"):
        if not arguments or arguments[0].startswith("-"):
            return
        path.append(arguments[0])
        command, arguments = command.commands[arguments[0]], arguments[1:]  # pyright: ignore[reportAttributeAccessIssue]
    if arguments:  # `gonio scale` alone is the command's name
        command.make_context(" ".join(path), list(arguments))


def test_each_command_of_the_pages_exists() -> None:
    wrong: list[str] = []
    calls = [(block.page, call) for block in blocks("sh") for call in commands(block.code)]
    for page, code in spans():
        if code.startswith("gonio "):
            calls += [(page, call) for call in commands(code)]
    for page, call in calls:
        try:
            parse(call)
        except Exception as error:
            wrong.append(f"{page.relative_to(ROOT)}: gonio {' '.join(call)}: {error!r}")
    assert len(calls) > 40
    assert wrong == []


@pytest.mark.parametrize("call", ["analyze FOLDER", "calibrate FOLDER --bord a1", "keys create lab --days soon"])
def test_the_command_guard_turns_red(call: str) -> None:
    with pytest.raises(Exception, match=r"'analyze'|--bord|valid number"):
        parse(call.split())


def test_each_address_of_the_pages_exists() -> None:
    paths = json.loads((DOCS / "reference" / "openapi.json").read_text())["paths"]
    templates = [re.compile(re.sub(r"\{name\}", r".+", re.sub(r"\{\w+_id\}", r"[^/]+", path)) + "$") for path in paths]
    named: set[str] = set()
    for page in PAGES:
        text = page.read_text()
        named |= set(re.findall(r"(?:[A-Z]+ |localhost:8000|127\.0\.0\.1:\d+|example\.org)(/v1/[\w/${}.-]+)", text))
        named |= {f"/v1{path}" for path in re.findall(r"\$G(/[\w/${}.-]+)", text)}
    unknown = sorted(path for path in named if not any(template.match(path) for template in templates))
    assert len(named) > 20
    assert unknown == []


def test_each_setting_target_and_bench_of_the_pages_exists() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    settings = {f"GONIO_{field.upper()}" for field in Settings.model_fields} | {"GONIO_KEY", "GONIO_ADMIN_KEY"}
    settings |= set(
        re.findall(r"GONIO_[A-Z_]+", "".join(p.read_text() for p in (ROOT / "service/gonio/bench").rglob("*.py")))
    )
    for page in PAGES:
        text = page.read_text()
        assert set(re.findall(r"(?:^ {4}|`|^)make ([a-z]+)", text, re.MULTILINE)) <= targets, page
        assert set(re.findall(r"GONIO_[A-Z_]+", text)) <= settings, page
        assert set(re.findall(r"NAME=([a-z_]+)", text)) <= set(list_benches()), page


def test_parameters_of_the_pages_are_valid() -> None:
    codes = [code for _, code in spans() if code.startswith('{"') and "…" not in code] + [
        block.code for block in blocks("json")
    ]
    codes = [
        code for code in codes if not code.startswith(('{"event"', '{"calibration"'))
    ]  # a message; a request's own
    wanted = [json.loads(code) for code in codes]
    assert len(wanted) > 8
    for values in wanted:
        for_calibration = set(values) <= {field.name for field in fields(CalibrationParameters)}
        (parse_calibration_parameters if for_calibration else parse_parameters)(values)


@pytest.mark.parametrize("block", blocks("toml"), ids=name)
def test_cards_are_read(block: Block, tmp_path: Path) -> None:
    path = tmp_path / "card.toml"
    is_excerpt = block.code.startswith("[background]")  # a table of a joint tree that the page shows elsewhere
    path.write_text(block.code + ('[parts.whole]\njoint = "free"\n' if is_excerpt else ""))
    read_pressure_card(path) if block.code.startswith("kind") else read_body_card(path)
