"""The house rules that no linter knows; each guard is shown to turn red."""

import ast
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gonio.pipeline.findings import KINDS, finding

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "service" / "gonio"
SOURCES = sorted(PACKAGE.rglob("*.py"))

MAX_STATEMENTS, MAX_LINES = 40, 500


def long_functions(source: str) -> list[str]:
    return [
        node.name
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and sum(isinstance(inner, ast.stmt) for inner in ast.walk(node)) - 1 > MAX_STATEMENTS
    ]


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_budgets(path: Path) -> None:
    source = path.read_text()
    assert source.count("\n") <= MAX_LINES
    assert long_functions(source) == []


def test_the_budget_guard_turns_red() -> None:
    assert long_functions("def f():\n" + "    x = 1\n" * 41) == ["f"]


def test_no_catch_all_modules() -> None:
    assert [p for p in SOURCES if p.stem in {"utils", "helpers", "common", "misc"}] == []


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"],
        cwd=root, capture_output=True, text=True, check=False,
        env={"PYTHONPATH": str(root / "service"), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("kernel/geometry/planted.py", "from gonio.pipeline import report"),
        ("kernel/planted.py", "import pandas"),
        ("records/planted.py", "import logging"),
        ("vision/planted.py", "from gonio.formats import calibration"),
        ("pipeline/planted.py", "from gonio.settings import Settings"),
    ],
)
def test_each_import_contract_turns_red(tmp_path: Path, module: str, line: str) -> None:
    shutil.copytree(
        ROOT / "service", tmp_path / "service", ignore=shutil.ignore_patterns("__pycache__", "node_modules")
    )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "service" / "gonio" / module).write_text(f"{line}\n")
    ran = lint_imports(tmp_path)
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert "planted" in ran.stdout


def test_the_import_contracts_hold() -> None:
    ran = lint_imports(ROOT)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_a_worker_starts_without_what_only_reports_need() -> None:
    """These are half of what there would be to load; whoever needs one imports it where it is used."""
    slow = {"matplotlib", "pandas", "scipy.signal", "scipy.stats"}
    script = f"import sys, gonio.jobs.worker, gonio.pipeline.rivers; print(*sorted({slow} & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_generated_pages_are_up_to_date() -> None:
    pages: dict[Path, str] = runpy.run_path(str(ROOT / "docs" / "generate.py"))["pages"]()
    stale = [str(p.relative_to(ROOT)) for p, text in pages.items() if not p.exists() or p.read_text() != text]
    assert stale == [], "run `make reference`"


def test_every_finding_that_is_made_is_in_the_table_and_every_kind_is_made() -> None:
    made = {code for p in SOURCES for code in re.findall(r"""\bfinding\(\s*["']([a-z-]+)["']""", p.read_text())}
    assert made == set(KINDS)


@pytest.mark.parametrize("code", KINDS)
def test_every_finding_reads_as_a_sentence_with_a_remedy(code: str) -> None:
    made = finding(code, where="cam01", value=12.0)
    assert made.message[0].isupper() or made.message[0].isdigit()
    assert made.message.endswith(".")
    assert "{" not in made.message
    assert made.hint.endswith((".", "?"))


def test_text_files_name_no_registry_and_no_machine() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    hosts = re.compile(r"pypi\.org|pythonhosted|registry\.npmjs|deb\.debian\.org|/root/|/home/\w+/")
    tests = "tests/architecture/test_house.py"
    named = [
        f for f in listed if f != tests and (ROOT / f).is_file() and hosts.search((ROOT / f).read_text(errors="ignore"))
    ]
    assert named == []
