"""The command line; ``gonio --help`` lists its commands."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer
from rich.console import Console

from gonio.errors import GonioError, InputError
from gonio.terminal import progress_bar, stage_lines

if TYPE_CHECKING:
    from gonio.formats.articulated import ArticulatedDocument
    from gonio.pipeline.opensim_tools import ToolResult

app = typer.Typer(
    help="gonio: from synchronized videos to a gait report that can be trusted.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
models_app = typer.Typer(help="The keypoint models: list them, fetch their weights.", no_args_is_help=True)
app.add_typer(models_app, name="models")
boards_app = typer.Typer(help="Calibration boards: list them, print them, make others.", no_args_is_help=True)
app.add_typer(boards_app, name="boards")
keys_app = typer.Typer(help="Labs' keys to the service: make, list, replace, revoke.", no_args_is_help=True)
app.add_typer(keys_app, name="keys")
console = Console(stderr=True, highlight=False)


def main() -> NoReturn:
    """Run the command line; a gonio error is two lines for people, not a traceback."""
    try:
        app(standalone_mode=False)
    except GonioError as error:
        console.print(f"[bold red]{error.code}[/]: {error.message}", soft_wrap=True)
        console.print(f"→ {error.hint}", soft_wrap=True)
        sys.exit(1)
    except (typer.Abort, KeyboardInterrupt):
        console.print("Stopped.")
        sys.exit(130)
    except typer.Exit as ended:
        sys.exit(ended.exit_code)
    except Exception as error:
        # Typer's own usage errors know how to show themselves; everything else keeps its traceback.
        show = getattr(error, "show", None)
        if show is None:
            raise
        show()
        sys.exit(getattr(error, "exit_code", 2))
    sys.exit(0)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 takes a free one.")] = None,
    workers: Annotated[int | None, typer.Option(help="Worker processes.")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Where sessions and reports are kept.")] = None,
) -> None:
    """Start the service and its workers; Ctrl-C stops all of them."""
    from gonio.http.server import serve as run
    from gonio.jobs.logs import set_up_logging
    from gonio.settings import Settings

    given = {"host": host, "port": port, "workers": workers, "data_dir": data_dir}
    settings = Settings().model_copy(update={name: value for name, value in given.items() if value is not None})
    set_up_logging(settings)
    run(settings, on_ready=lambda url: console.print(f"gonio listens on {url} (API reference: {url}/docs)"))


@app.command()
def worker() -> None:
    """Join the service with GONIO_WORKERS more workers, from this or another machine; Ctrl-C stops them."""
    from gonio.jobs.logs import set_up_logging
    from gonio.jobs.supervisor import supervise
    from gonio.settings import Settings

    settings = Settings()
    set_up_logging(settings)
    supervise(settings)


@app.command()
def analyse(
    folder: Annotated[Path, typer.Argument(help="Holds the videos and the calibration, also in subfolders.")],
    calibration: Annotated[
        Path | None, typer.Option(help="The cameras' calibration, in place of one in FOLDER (Calib.qca.txt).")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Where the report goes. [default: FOLDER/gonio]")] = None,
    parameters: Annotated[Path | None, typer.Option(help="A JSON file of parameters.")] = None,
    one_camera: Annotated[
        bool, typer.Option("--one-camera", help="FOLDER holds one camera's recording; give the subject's stature.")
    ] = False,
) -> None:
    """Analyse a folder of recordings without a server."""
    from gonio.pipeline.folder import find_capture_files
    from gonio.pipeline.report import key_lines, load_report
    from gonio.pipeline.rivers import RIVERS
    from gonio.pipeline.run import CaptureFile, LocalRunner

    river = RIVERS["human_monocular" if one_camera else "human_multicamera"]
    wanted = _read_parameters(parameters) if parameters else {}
    files = find_capture_files(folder)
    if calibration is not None:
        files = [file for file in files if file.role != "calibration"]
        files.append(CaptureFile(path=calibration, name=calibration.name, role="calibration"))
    with progress_bar(console) as advance:
        runner = LocalRunner(advance, river.shares)
        report = river.compute(files, wanted, runner, output or folder / "gonio")
    for line in (*key_lines(load_report(report.document)), stage_lines(runner.seconds), f"Report: {report.page}"):
        print(line)


@app.command()
def calibrate(
    folder: Annotated[
        Path, typer.Argument(help="Holds a video of the board a camera, named after it; lenses' own in `intrinsics`.")
    ],
    board: Annotated[
        str, typer.Option(help="One of gonio's boards, or a card's file. [default: a card in FOLDER]")
    ] = "",
    optics: Annotated[Path | None, typer.Option(help="A calibration whose lenses are still right.")] = None,
    check: Annotated[
        Path | None, typer.Option(help="gonio's earlier calibration of these cameras: has one of them moved?")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Where the calibration goes. [default: FOLDER/gonio]")] = None,
    parameters: Annotated[Path | None, typer.Option(help="A JSON file of parameters.")] = None,
) -> None:
    """Calibrate cameras from videos of a board, and say whether to trust the result."""
    from gonio.formats.calibration_json import read_calibration_document
    from gonio.pipeline.calibration import CALIBRATION_SHARES, calibrate
    from gonio.pipeline.calibration_files import find_calibration_files
    from gonio.pipeline.calibration_report import calibration_key_lines
    from gonio.pipeline.run import CaptureFile, LocalRunner

    wanted = _read_parameters(parameters) if parameters else {}
    files = find_calibration_files(folder)
    if optics is not None:
        files = [file for file in files if file.role != "optics"]
        files.append(CaptureFile(path=optics, name=optics.name, role="optics"))
    if check is not None:
        files.append(CaptureFile(path=check, name=check.name, role="previous"))
    if board.endswith(".toml"):
        files = [file for file in files if file.role != "board"]
        files.append(CaptureFile(path=Path(board), name=board, role="board"))
    elif board:
        wanted["board"] = board
    with progress_bar(console) as advance:
        runner = LocalRunner(advance, CALIBRATION_SHARES)
        written = calibrate(files, wanted, runner, output or folder / "gonio")
    calibration = read_calibration_document(written.document)
    for line in (*calibration_key_lines(calibration), stage_lines(runner.seconds), f"Report: {written.page}"):
        print(line)
    sys.exit(3 if calibration.verdict.level == "reject" else 0)


def _read_parameters(path: Path) -> dict[str, object]:
    try:
        wanted = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path.name} can't be read as JSON: {error}.", hint="Give a JSON object.") from error
    if not isinstance(wanted, dict):
        raise InputError(f"{path.name} holds no JSON object.", hint='Give one, such as {"subject": {"mass_kg": 70}}.')
    return wanted


@app.command()
def scale(setup: Annotated[Path, typer.Argument(help="OpenSim's setup of a ScaleTool, unchanged.")]) -> None:
    """Scale a body model as OpenSim's ScaleTool does."""
    from gonio.pipeline.opensim_tools import run_scale

    _tell(run_scale(setup)[1])


@app.command()
def ik(setup: Annotated[Path, typer.Argument(help="OpenSim's setup of an InverseKinematicsTool, unchanged.")]) -> None:
    """Find joint angles from markers as OpenSim's InverseKinematicsTool does."""
    from gonio.pipeline.opensim_tools import run_kinematics

    _tell(run_kinematics(setup)[1])


@app.command()
def articulated(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Holds body.toml, tracks.csv or .json, and cameras.json or .toml, background.csv or a folder of pictures."
        ),
    ],
    output: Annotated[Path | None, typer.Option(help="The result. [default: motion.json in the folder]")] = None,
    voxels: Annotated[int, typer.Option(help="Voxels along a carved part's longest side.")] = 128,
) -> None:
    """Find how the joints of a body moved between a few pictures of one moving camera; with masks, its parts in 3D."""
    from gonio.pipeline.articulated import articulated_lines, solve_folder

    document = solve_folder(folder, output)
    for line in articulated_lines(document):
        print(line)
    print(output or folder / "motion.json")
    if (folder / "masks").is_dir():
        _carve(folder, document, voxels)


def _carve(folder: Path, motion: "ArticulatedDocument", voxels: int) -> None:
    from gonio.pipeline.articulated import cameras_of
    from gonio.pipeline.carving import carve_folder

    carving = carve_folder(folder, cameras_of(folder, motion), motion, voxels)
    for part in carving.parts:
        overlap = ", ".join(f"{picture} {100 * share:.1f} %" for picture, share in part.overlap.items())
        print(f"{part.part}: {1e3 * part.volume_m3:.3g} l; covers its masks to {overlap}")
    for finding in carving.findings:
        console.print(f"{finding.severity}: {finding.message}\n→ {finding.hint}", soft_wrap=True)
    print(folder / "carving.json")


@app.command()
def mask(
    picture: Annotated[Path, typer.Argument(help="The photograph.")],
    box: Annotated[str, typer.Option(help="Around the part, closely: LEFT,TOP,RIGHT,BOTTOM in pixels.")],
    output: Annotated[Path, typer.Option(help="The mask to write, such as masks/arm/left.png.")],
    without: Annotated[Path | None, typer.Option(help="The mask of another part that lies in the box.")] = None,
) -> None:
    """Cut a part out of its box in a photograph; look at the mask, and mend it in any painting programme."""
    from gonio.vision.masks import cut_out, read_mask, write_mask
    from gonio.vision.stills import read_rgb

    try:
        left, top, right, bottom = (int(part) for part in box.split(","))
    except ValueError as error:
        raise InputError(
            f"The box {box!r} is not four whole numbers.", hint="Write --box 120,80,410,390.", code="box-unfit"
        ) from error
    rgb = read_rgb(picture)
    other = None if without is None else read_mask(without, (rgb.shape[1], rgb.shape[0]))
    found = cut_out(rgb, (left, top, right, bottom), without=other)
    write_mask(output, found)
    print(
        f"{output}: {int(found.sum())} pixels, {100 * found.sum() / ((right - left) * (bottom - top)):.0f} % of the box"
    )


@app.command("id")
def inverse_dynamics(
    setup: Annotated[Path, typer.Argument(help="OpenSim's setup of an InverseDynamicsTool, unchanged.")],
    conventions: Annotated[
        Literal["opensim", "gonio"], typer.Option(help="OpenSim's filter and couplers to the digit, or gonio's own.")
    ] = "opensim",
) -> None:
    """Find joint torques from a motion and external forces as OpenSim's InverseDynamicsTool does."""
    from gonio.pipeline.opensim_dynamics import run_dynamics

    _tell(run_dynamics(setup, conventions)[2])


def _tell(result: "ToolResult") -> None:
    for remark in result.remarks:
        console.print(f"→ {remark}", soft_wrap=True)
    for file in result.files:
        print(file)


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Where the service keeps its data and the report goes.")] = Path(
        "gonio-demo"
    ),
    from_file: Annotated[
        list[Path] | None,
        typer.Option(help="A file to use instead of fetching it: the package of the weights or the recording."),
    ] = None,
    virtual: Annotated[
        bool,
        typer.Option(
            "--virtual",
            help="Upload and analyse a walk of the virtual laboratory instead, and print how far the report is from the "
            "truth. Needs no network and no weights.",
        ),
    ] = False,
    articulated: Annotated[
        bool,
        typer.Option(
            "--articulated",
            help="Upload and solve the marks of a virtual mannequin in four pictures of one moving camera instead, and print "
            "how far the report is from the truth. Needs no network and no weights.",
        ),
    ] = False,
) -> None:
    """Send four real videos over HTTP through a running service, and read the report."""
    if articulated:
        from gonio.demo.articulated import run_articulated_demo

        run_articulated_demo(output, console)
        return
    if virtual:
        from gonio.demo.virtual import run_virtual_demo

        run_virtual_demo(output, console)
        return
    from gonio.demo.run import run_demo

    run_demo(output, from_file or [], console)


@keys_app.command("create")
def create_key(
    lab: Annotated[str, typer.Argument(help="Whose data it opens: small letters, digits, hyphens.")],
    name: Annotated[str, typer.Option(help="Who or what has it.")] = "",
    scope: Annotated[list[str] | None, typer.Option(help="read, write or admin. [default: read and write]")] = None,
    days: Annotated[float | None, typer.Option(help="How long it is valid. [default: until it is revoked]")] = None,
) -> None:
    """Make a key and print it: it is shown this once."""
    from datetime import timedelta

    from gonio.jobs.access import SCOPES, Scope, opened
    from gonio.settings import Settings

    wanted = set(scope or ("read", "write"))
    scopes: list[Scope] = [each for each in SCOPES if each in wanted]
    if unknown := wanted.difference(SCOPES):
        raise InputError(
            f"There is no scope {', '.join(sorted(unknown))}.",
            hint=f"Choose of: {', '.join(SCOPES)}.",
            code="scope-unknown",
        )
    with opened(Settings()) as access:
        made = access.create_key(lab, name or lab, scopes, None if days is None else timedelta(days=days))
    print(made.secret)


@keys_app.command("list")
def list_keys(lab: Annotated[str, typer.Argument(help="Whose keys.")]) -> None:
    """List a lab's keys, newest first."""
    from gonio.jobs.access import opened
    from gonio.settings import Settings

    with opened(Settings()) as access:
        for row in access.keys(lab):
            used = f"used {row.last_used_at:%Y-%m-%d %H:%M}" if row.last_used_at else "never used"
            end = f", ends {row.expires_at:%Y-%m-%d %H:%M}" if row.expires_at else ""
            print(f"{row.id}  {','.join(row.scopes)}  {row.name}  ({used}{end}, UTC)")


@keys_app.command("rotate")
def rotate_key(
    lab: Annotated[str, typer.Argument(help="Whose key.")],
    key_id: Annotated[str, typer.Argument(help="Its id, as `gonio keys list` shows it.")],
    grace_hours: Annotated[float, typer.Option(min=0, help="So long the old key stays valid.")] = 24.0,
) -> None:
    """Make a key like this one and print it; the old one ends after a time of grace."""
    from datetime import timedelta

    from gonio.jobs.access import opened
    from gonio.settings import Settings

    with opened(Settings()) as access:
        print(access.rotate_key(lab, key_id, timedelta(hours=grace_hours)).secret)


@keys_app.command("revoke")
def revoke_key(
    lab: Annotated[str, typer.Argument(help="Whose key.")],
    key_id: Annotated[str, typer.Argument(help="Its id, as `gonio keys list` shows it.")],
) -> None:
    """Revoke a key: the service refuses it from now on."""
    from gonio.jobs.access import opened
    from gonio.settings import Settings

    with opened(Settings()) as access:
        access.revoke_key(lab, key_id)


@models_app.command("list")
def list_models() -> None:
    """List the keypoint models and whether their weights are here."""
    from gonio.settings import Settings
    from gonio.vision.model_cards import list_cards, load_card
    from gonio.vision.weights import cached_weights

    for card in map(load_card, list_cards()):
        state = "here" if cached_weights(card, Settings().cache_dir) else "not fetched"
        print(f"{card.name:20} {state:12} {card.licence:12} {card.credit}")


@models_app.command("fetch")
def fetch_models(
    names: Annotated[
        list[str] | None, typer.Argument(help="Models to fetch. [default: what an analysis needs]")
    ] = None,
    from_file: Annotated[
        list[Path] | None, typer.Option(help="A package or weights file to use instead of the network.")
    ] = None,
) -> None:
    """Fetch and convert the weights of keypoint models."""
    from gonio.demo.weights import ensure_models

    ensure_models(names or None, from_file or [], console)


@boards_app.command("list")
def list_boards() -> None:
    """List the boards that gonio ships."""
    from gonio.formats.board_card import list_board_cards, load_board_card
    from gonio.pipeline.boards import describe_board

    for card in map(load_board_card, list_board_cards()):
        print(f"{describe_board(card)}; {card.paper}")


@boards_app.command("print")
def print_boards(
    names: Annotated[list[str], typer.Argument(help="Boards by name, or cards' files.")],
    output: Annotated[Path, typer.Option(help="Folder for the PDFs.")] = Path(),
    tile: Annotated[str | None, typer.Option(help="Cut into pages of this paper: A4, A3 …")] = None,
) -> None:
    """Write boards as PDFs of exact size."""
    from gonio.formats.board_card import load_board_card, read_board_card
    from gonio.pipeline.boards import paper_named, print_board

    output.mkdir(parents=True, exist_ok=True)
    for name in names:
        card = read_board_card(Path(name)) if name.endswith(".toml") else load_board_card(name)
        path = output / f"{Path(name).stem}.pdf"
        pages = print_board(card, path, paper_named(tile) if tile else None)
        print(f"{path}: {pages} page{'' if pages == 1 else 's'}")


@boards_app.command("make")
def make_board(
    path: Annotated[Path, typer.Argument(help="The card to write (.toml); the PDF goes beside it.")],
    corners: Annotated[str, typer.Option(help="Inner corners, across × down, such as 8x5.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square.")],
    paper: Annotated[str, typer.Option(help="A4, A3, A2, A1 or A0.")] = "A3",
    dictionary: Annotated[str, typer.Option(help="Markers of a ChArUco board; empty: a checkerboard.")] = "DICT_4X4_50",
    inverted: Annotated[bool, typer.Option("--inverted", help="White on black.")] = False,
    tile: Annotated[str | None, typer.Option(help="Cut the PDF into pages of this paper.")] = None,
) -> None:
    """Make a board of your own: its card and its PDF."""
    from gonio.formats.board_card import read_board_card
    from gonio.pipeline.boards import card_text, paper_named, print_board

    text = card_text(corners, square_mm, paper_named(paper), dictionary, inverted=inverted)
    path.write_text(text, encoding="utf-8")
    try:
        pages = print_board(read_board_card(path), path.with_suffix(".pdf"), paper_named(tile) if tile else None)
    except GonioError:
        path.unlink()
        raise
    print(f"{path}, {path.with_suffix('.pdf')}: {pages} page{'' if pages == 1 else 's'}")


@app.command()
def bench(
    name: Annotated[str, typer.Argument(help="One bench; all without a name.")] = "",
    check: Annotated[
        bool, typer.Option("--check", help="Measure nothing: compare what was measured with the baseline.")
    ] = False,
    baseline: Annotated[Path, typer.Option(help="The folder with the committed runs.")] = Path(
        "docs/benchmarks/baseline"
    ),
) -> None:
    """Measure accuracy and speed against the rivals, in the same run."""
    from gonio.bench import run_benches
    from gonio.bench.gate import check as check_runs

    if check:
        check_runs(name, Path("build") / "bench", baseline, console)
    else:
        run_benches(name, Path("build"), console)


@app.command()
def doctor() -> None:
    """Tell what is installed and what is missing, and analyse a virtual walk whose truth is known."""
    from gonio.doctor import examine

    console.print("The self-test takes seconds; the first time, code is compiled for it, and it takes a minute or two.")
    findings = examine()
    for finding in findings:
        mark = "[green]✓[/]" if finding.good else "[red]✗[/]" if finding.needed else "[yellow]–[/]"
        console.print(f"{mark} {finding.what}: {finding.state}", soft_wrap=True)
        if not finding.good:
            console.print(f"   → {finding.remedy}", soft_wrap=True)
    sys.exit(1 if any(f.needed and not f.good for f in findings) else 0)
