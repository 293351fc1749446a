"""The dashboard in a real browser, from an empty service to the printed report, with a server that dies on the way."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from gonio.demo.virtual import film_walk, write_session, write_videos
from gonio.http.dashboard import PAGE
from gonio.kernel.virtual_lab import make_rig
from gonio.settings import Settings

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
AXE = Path(__file__).parents[2] / "service" / "dashboard" / "node_modules" / "axe-core" / "axe.min.js"
GONIO = Path(sys.executable).with_name("gonio")
FLAGS = ["--no-sandbox", "--disable-background-networking", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
SLOW_BYTES_S = 400_000

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium (apt-get install chromium)"),
    pytest.mark.skipif(not PAGE.is_dir(), reason="the dashboard is not built (make .venv/dashboard)"),
]


class Service:
    """`gonio serve` on a port of its own, which can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._settings = Settings(
            data_dir=folder / "data", cache_dir=folder / "cache", port=self.port, free_disk_floor=0
        )
        self._log = folder / "service.log"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [GONIO, "serve"]
        with self._log.open("a") as log:
            environment = {**os.environ, **self._settings.environment()}
            self._process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        deadline_s = time.monotonic() + 60
        while not self.is_ready():
            assert time.monotonic() < deadline_s, self._log.read_text()
            time.sleep(0.1)

    def is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", trust_env=False).is_success
        except httpx.HTTPError:
            return False

    def stop(self, how: signal.Signals = signal.SIGTERM) -> None:
        assert self._process is not None
        self._process.send_signal(how)
        self._process.wait(30)


class Watch:
    """What a page must not do: raise errors, fail to load, ask another host."""

    def __init__(self, page: Page, url: str) -> None:
        self.wrong: list[str] = []
        self.paused = False
        page.on("console", lambda message: self.note(message.type == "error", f"console: {message.text}"))
        page.on("pageerror", lambda error: self.note(True, f"error: {error}"))
        page.on("request", lambda request: self.note(not self._own(request.url, url), f"foreign: {request.url}"))
        page.on("response", lambda answer: self.note(answer.status >= 400, f"{answer.status}: {answer.url}"))

    def _own(self, asked: str, url: str) -> bool:
        return asked.startswith((url, "data:", "blob:"))

    def note(self, wrong: bool, what: str) -> None:
        if wrong and not self.paused:
            self.wrong.append(what)

    @contextmanager
    def pause(self) -> Iterator[None]:
        self.paused = True
        yield
        self.paused = False


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recording")
    # Two thirds of the demo's pictures: half of the time went into drawing them.
    trial = film_walk(2.4, make_rig(image_size_px=(480, 360), focal_px=347.0))
    return [*write_session(trial, folder), *write_videos(trial, folder)]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    service.start()
    yield service
    service.stop()


@pytest.fixture
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)


def check_accessibility(page: Page) -> None:
    """No violation of WCAG 2 A and AA that axe can find."""
    if not AXE.is_file():
        pytest.skip("axe-core is not installed (npm ci in service/dashboard)")
    page.evaluate(AXE.read_text())
    found = page.evaluate("axe.run({runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa']})")["violations"]
    assert not found, [(one["id"], [node["html"][:120] for node in one["nodes"][:3]]) for one in found]


def test_from_an_empty_service_to_the_printed_report(
    service: Service, browser: Browser, recording: list[Path], tmp_path: Path
) -> None:
    page = browser.new_page(viewport={"width": 1400, "height": 1000}, accept_downloads=True)
    watch = Watch(page, service.url)
    page.goto(service.url)
    expect(page.get_by_text("No session yet.")).to_be_visible()
    check_accessibility(page)
    create_session(page)
    upload_while_the_server_dies(page, service, watch, recording)
    check_accessibility(page)
    choose_options(page)
    with page.expect_request("**/v1/jobs/*/events"), page.expect_request("**/analyses") as asked:
        page.get_by_role("button", name="Analyse").click()
    assert asked.value.post_data_json == {"parameters": {"forces": {"task": "walking"}}}
    expect(page.get_by_role("progressbar", name="Progress of the job")).to_be_visible()
    page.get_by_role("link", name="Open the report").click(timeout=180_000)
    use_the_report(page)
    check_accessibility(page)
    print_the_report(page, browser, tmp_path)
    compare_trials(page)
    begin_a_calibration(page, recording)
    assert watch.wrong == []


def wait_until(page: Page, condition: str) -> None:
    """Wait for an expression to be true; Playwright's own way evaluates text in the page, which its policy forbids."""
    deadline_s = time.monotonic() + 30
    while not page.evaluate(condition):
        assert time.monotonic() < deadline_s, condition
        page.wait_for_timeout(50)


def create_session(page: Page) -> None:
    page.get_by_role("link", name="New session").click()
    page.get_by_label("Name").fill("Anna, barefoot")
    page.get_by_label("Code").fill("P07")
    page.get_by_label("Mass, kg").fill("61")
    page.get_by_label("Stature, m").fill("1,66")
    page.get_by_label("Sex").select_option("female")
    page.get_by_label("one camera").check()
    expect(page.get_by_text("All lengths rest on the stature.")).to_be_visible()
    page.get_by_label("one moving camera").check()
    expect(page.get_by_label("Stature, m")).to_be_hidden()  # a thing has none
    page.get_by_label("several cameras, at once").check()
    expect(page.get_by_label("Stature, m")).to_have_value("1,66")  # what was typed stays
    check_accessibility(page)
    page.get_by_role("button", name="Create").click()
    expect(page.get_by_role("heading", name="Anna, barefoot")).to_be_visible()
    expect(page.get_by_role("button", name="Analyse")).to_be_disabled()


def choose_options(page: Page) -> None:
    """What differs from the defaults is asked for, and nothing else."""
    page.get_by_text("Options of the analysis").click()
    page.get_by_label("What the subject does").select_option("walking")
    page.get_by_label("How closely the videos are looked at").select_option("fast")
    page.get_by_text("More, for those who know why").click()
    expect(page.get_by_label("Way from pictures to space")).to_have_value("")
    check_accessibility(page)
    page.get_by_label("How closely the videos are looked at").select_option("")


def upload_while_the_server_dies(page: Page, service: Service, watch: Watch, recording: list[Path]) -> None:
    """All files arrive whole, though the server is killed while they are on their way."""
    slow = page.context.new_cdp_session(page)
    limits = {"offline": False, "latency": 0, "downloadThroughput": -1}
    slow.send("Network.emulateNetworkConditions", {**limits, "uploadThroughput": SLOW_BYTES_S})
    page.get_by_label("Files to upload").set_input_files(recording)
    expect(page.locator(".uploads li.sending").first).to_be_visible()
    with watch.pause():
        service.stop(signal.SIGKILL)
        expect(page.get_by_text("The connection was cut.").first).to_be_visible()
        service.start()
        slow.send("Network.emulateNetworkConditions", {**limits, "uploadThroughput": -1})
        expect(page.locator(".uploads li.done")).to_have_count(len(recording), timeout=60_000)
    expect(page.locator("table tbody tr")).to_have_count(len(recording))
    names = page.locator("table tbody tr td:first-child").all_inner_texts()
    assert sorted(names) == sorted(path.name for path in recording)


def use_the_report(page: Page) -> None:
    expect(page.get_by_role("heading", name="Anna, barefoot")).to_be_visible()
    moment = page.get_by_role("slider", name="Moment")
    expect(page.locator(".scene canvas")).to_be_visible()
    wait_until(page, "[...document.querySelectorAll('video')].every((video) => video.readyState >= 2)")
    moment.fill("1.5")
    wait_until(page, "[...document.querySelectorAll('video')].every((v) => Math.abs(v.currentTime - 1.5) < 0.1)")
    page.locator(".verdict").click()  # out of the slider: the keys are the page's
    page.keyboard.press("ArrowRight")
    assert float(moment.input_value()) == pytest.approx(1.5 + 1 / 60, abs=1e-3)
    page.keyboard.press(" ")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    page.keyboard.press(" ")
    before = page.locator(".scene").screenshot()
    page.keyboard.press("Home")
    assert page.locator(".scene").screenshot() != before  # the skeleton is somewhere else
    page.get_by_role("button", name="Whole trial").click()
    plot = page.locator(".curve .u-over").first
    box = plot.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20)
    assert float(moment.input_value()) == pytest.approx(1.2, abs=0.1)  # the middle of 2.4 s
    expect(page.locator(".curve output").first).to_contain_text("±")
    page.get_by_role("button", name="Show it").first.click()
    said = page.get_by_role("button", name="Show it").first.inner_text()
    assert float(moment.input_value()) == pytest.approx(float(said.split()[3]), abs=0.06)  # said to a tenth
    for words in ("Findings", "cadence", "motion.mot"):
        expect(page.get_by_text(words).first).to_be_visible()


def compare_trials(page: Page) -> None:
    """From the subject to two of their trials in one view; one analysis, twice, differs by nothing."""
    report = page.url.rpartition("/")[2]
    page.get_by_role("link", name="gonio", exact=True).click()
    page.get_by_role("link", name="P07", exact=True).click()
    expect(page.get_by_role("checkbox", name="Anna, barefoot")).to_be_visible()
    check_accessibility(page)
    page.goto(page.url.partition("#")[0] + f"#/compare/{report}/{report}")
    expect(page.locator(".scene canvas")).to_have_count(2)
    verdicts = page.locator(".pair .state").all_inner_texts()
    assert verdicts[0] == verdicts[1] in ("Good", "Usable with care")  # which of two trials may be believed
    page.get_by_role("button", name="Right", exact=True).click()
    cadence = page.get_by_role("row").filter(has_text="cadence").get_by_role("cell")
    assert cadence.nth(2).inner_text() == cadence.nth(3).inner_text() != "–"
    assert float(cadence.last.inner_text()) == 0
    check_accessibility(page)


def begin_a_calibration(page: Page, recording: list[Path]) -> None:
    """A lens filmed alone goes with its camera's name, and a calibration that was not started is found again."""
    page.get_by_role("link", name="gonio", exact=True).click()
    page.get_by_role("link", name="Calibrate cameras").click()
    page.get_by_label("Name").fill("Lab 2")
    page.get_by_role("button", name="Create").click()
    page.get_by_label("The videos show").select_option("lens")
    page.get_by_label("Files to upload").set_input_files(next(path for path in recording if path.suffix == ".mp4"))
    expect(page.get_by_role("cell", name="board for one lens of cam1")).to_be_visible()
    page.get_by_text("Measured with a tape").click()
    check_accessibility(page)
    page.get_by_role("link", name="gonio", exact=True).click()
    expect(page.get_by_role("row", name="Lab 2")).to_contain_text("not started")


def print_the_report(page: Page, browser: Browser, tmp_path: Path) -> None:
    address = page.get_by_role("link", name="Page to print").get_attribute("href")
    sheet = browser.new_page()
    sheet.goto(page.url.partition("#")[0].rstrip("/") + str(address))
    expect(sheet.get_by_text("Knee flexion").first).to_be_visible()
    printed = sheet.pdf(path=tmp_path / "report.pdf", prefer_css_page_size=True)
    assert printed.count(b"/Type /Page\n") == 2


def test_a_key_opens_the_dashboard_and_signing_out_closes_it(tmp_path: Path, browser: Browser) -> None:
    service = Service(tmp_path)
    command = [GONIO, "keys", "create", "north", "--name", "browser"]
    made = subprocess.run(
        command, env={**os.environ, **service._settings.environment()}, capture_output=True, text=True, check=True
    )
    key = next(word for word in (made.stdout + made.stderr).split() if word.startswith("gonio_"))
    service.start()
    try:
        page = browser.new_page()
        page.goto(service.url)
        page.get_by_label("Your lab's key").fill("gonio_wrong")
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_role("alert")).to_contain_text("unknown")
        page.get_by_label("Your lab's key").fill(key)
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_text("No session yet.")).to_be_visible()
        assert page.evaluate("document.cookie") == ""
        page.get_by_role("button", name="Sign out of north").click()
        expect(page.get_by_label("Your lab's key")).to_be_visible()
    finally:
        service.stop()
