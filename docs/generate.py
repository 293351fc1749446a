"""Write the reference pages that are made from the code: `make reference`. A test holds that they are up to date."""

import json
import re
import sys
from pathlib import Path

from gonio.formats.articulated import articulated_schema
from gonio.formats.calibration_json import calibration_schema
from gonio.formats.carving import carving_schema
from gonio.http.app import create_app
from gonio.kernel.calibration.verdict import CRITERIA
from gonio.pipeline.findings import KINDS
from gonio.pipeline.params import calibration_parameters_schema, parameters_schema
from gonio.pipeline.report_schema import report_schema
from gonio.settings import Settings

sys.path.insert(0, str(Path(__file__).parent / "tools"))

from benchmarks import benchmark_pages, draw_plots
from rest import parameters_page, rest_page

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
        message = re.sub(r"{value:g [^|}]+\|([^}]+)}", r"*value* \1", message)
        for value in ("{value:g}", "{value:.0f}", "{value:.1f}", "{value:.2f}"):
            message = message.replace(value, "*value*")
        lines += [f"## `{code}`", "", f"*{kind.severity}, stage {kind.stage}*", "", message, "", kind.hint, ""]
    return "\n".join(lines)


def verdict_page() -> str:
    """Make the page of the criteria that a calibration is judged by."""
    lines = [
        "# A calibration's verdict",
        "",
        "Every calibration is accepted, accepted with warnings, or rejected: by the worst of these criteria. None of them is",
        "the error on the pictures that the solution was made from: that number is low for bad calibrations too. Limits in",
        "pixels are for pictures up to 1280 wide and grow with them.",
        "",
        "Made from `gonio/kernel/calibration/verdict.py` by `make reference`.",
        "",
        "| criterion | accepted | with a warning | why |",
        "|---|---|---|---|",
    ]
    for name, criterion in CRITERIA.items():
        sign = "≥" if criterion.at_least else "≤"
        accept, warn = (f"{sign} {limit:g} {criterion.unit}".strip() for limit in (criterion.accept, criterion.warn))
        lines.append(f"| `{name}` | {accept} | {'≤ one frame' if name == 'delay_ms' else warn} | {criterion.reason} |")
    return "\n".join([*lines, ""])


def pages() -> dict[Path, str]:
    """Give each generated file with its text."""
    api = create_app(Settings()).openapi()
    return {
        REFERENCE / "findings.md": findings_page(),
        REFERENCE / "calibration-verdict.md": verdict_page(),
        REFERENCE / "carving.schema.json": json.dumps(carving_schema(), indent=2, ensure_ascii=False) + "\n",
        REFERENCE / "articulated.schema.json": json.dumps(articulated_schema(), indent=2, ensure_ascii=False) + "\n",
        REFERENCE / "calibration.schema.json": json.dumps(calibration_schema(), indent=2, ensure_ascii=False) + "\n",
        REFERENCE / "openapi.json": json.dumps(api, indent=2, ensure_ascii=False) + "\n",
        **benchmark_pages(),
        REFERENCE / "rest.md": rest_page(api),
        REFERENCE / "parameters.md": parameters_page(parameters_schema(), calibration_parameters_schema()),
        REFERENCE / "report.schema.json": json.dumps(report_schema(), indent=2, ensure_ascii=False) + "\n",
    }


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
    draw_plots()
