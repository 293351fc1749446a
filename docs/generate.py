"""Write the reference pages that are made from the code: `make reference`. A test holds that they are up to date."""

import json
from pathlib import Path

from gonio.pipeline.findings import KINDS
from gonio.pipeline.report_schema import report_schema

REFERENCE = Path(__file__).parent / "reference"


def findings_page() -> str:
    """Make the page of all findings."""
    lines = [
        "# Findings",
        "",
        "What a report can say about a recording. A `serious` finding makes the verdict *poor*, a `warning` makes it *usable*.",
        "Some become serious when their value is bad enough. Made from `gonio/pipeline/findings.py` by `make reference`.",
        "",
    ]
    for code, kind in KINDS.items():
        message = kind.message.replace("{where}", "*where*")
        for value in ("{value:g}", "{value:.0f}", "{value:.1f}"):
            message = message.replace(value, "*value*")
        lines += [f"## `{code}`", "", f"*{kind.severity}, stage {kind.stage}*", "", message, "", kind.hint, ""]
    return "\n".join(lines)


def pages() -> dict[Path, str]:
    """Give each generated file with its text."""
    return {
        REFERENCE / "findings.md": findings_page(),
        REFERENCE / "report.schema.json": json.dumps(report_schema(), indent=2, ensure_ascii=False) + "\n",
    }


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
