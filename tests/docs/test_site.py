"""The site: every page has its place, every link leads somewhere, and it is built without a warning."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from markdown.extensions.toc import slugify

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
OUTSIDE = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
FENCED = re.compile(r"^ *(```+).*?^ *\1", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def prose(text: str) -> str:
    """The text without its code."""
    return re.sub(r"`[^`\n]+`", "", FENCED.sub("", text))


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as the site makes them."""
    headings = re.findall(r"^#+ +(.+)$", FENCED.sub("", text), re.MULTILINE)
    return {slugify(re.sub(r"[`*]", "", heading), "-") for heading in headings}


def broken_links(page: Path, text: str) -> list[str]:
    """The links of a page to files or headings that are not there."""
    broken = []
    for target in LINK.findall(prose(text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if not path.exists() or (anchor and anchor not in anchors(path.read_text())):
            broken.append(target)
    return broken


@pytest.mark.parametrize("page", [*PAGES, *OUTSIDE], ids=lambda p: str(p.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    text = page.read_text()
    assert broken_links(page, text) == []
    if page not in OUTSIDE:
        away = [t for t in LINK.findall(prose(text)) if not re.match(r"[a-z]+:|#", t) and t.startswith("../../")]
        assert away == [], "the site has nothing outside of docs"


def test_the_link_guard_turns_red() -> None:
    text = "[a](nobody.md) [b](conventions.md#nothing) [c](conventions.md#units)\n```\n[d](code.md)\n```\n`[e](x.md)`"
    assert broken_links(DOCS / "page.md", text) == ["nobody.md", "conventions.md#nothing"]


def nav_pages(entries: object) -> Iterator[str]:
    """The pages that a part of the navigation names."""
    if isinstance(entries, str):
        yield entries
    elif isinstance(entries, dict | list):
        for entry in entries.values() if isinstance(entries, dict) else entries:
            yield from nav_pages(entry)


def test_every_page_is_in_the_navigation_once() -> None:
    named = sorted(nav_pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]))
    assert named == sorted(str(page.relative_to(DOCS)) for page in PAGES)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it, but elsewhere."""
    folder = tmp_path_factory.mktemp("docs")
    shutil.copytree(DOCS, folder / "docs", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "mkdocs.yml").write_text((ROOT / "mkdocs.yml").read_text())
    environment = os.environ | {"PYTHONPATH": str(folder / "docs" / "tools")}
    command = [str(Path(sys.executable).parent / "zensical"), "build", "--strict"]
    built = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert "No issues found" in built.stderr
    return folder / "build" / "site"


def test_the_site_asks_no_other_host(site: Path) -> None:
    loads = re.compile(r"""(?:src=|<link[^>]+href=|url\(|@import )["']?(https?://[^"')\s]+)""")
    pages = [*site.rglob("*.html"), *site.rglob("*.css")]
    assert len(pages) > len(PAGES)
    assert {(p.name, host) for p in pages for host in loads.findall(p.read_text())} == set()


def test_formulas_are_set(site: Path) -> None:
    html = (site / "derivations" / "forces.html").read_text()
    assert html.count("<math") > 30
    assert "$" not in re.sub(r"<math.*?</math>|<script.*?</script>|<code.*?</code>", "", html, flags=re.DOTALL)
