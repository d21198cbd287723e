"""The page in a real browser: headless Chromium pushes, records, keeps, plays, forgets, saves."""

import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from hasm_torch.config import HASMConfig
from hasm_torch.data.episodes import load_episodes
from hasm_torch.data.training import train
from hasm_torch.model.hasm import HASM
from hasm_torch.robot import JOINTS
from hasm_torch.touch.page import Page
from hasm_torch.touch.pointing import cells_in_world
from hasm_torch.touch.session import POSTURE, Session
from hasm_torch.touch.shelf import Shelf
from hasm_torch.touch.simulated import body_in

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None,
    reason="the page is tested in Chromium, which is not installed: apt-get install chromium",
)
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
ROOT = Path(__file__).parents[1]
PATIENCE = 25.0  # s, of a test that waits for what never comes


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def served(tmp_path):
    """A session of an empty robot, served."""
    model = HASM(HASMConfig(drive="spike"), body_in("compliance"))
    session = Session("compliance", model, Shelf(tmp_path), seed=0)
    page = Page(session, port=8790)
    session.start()
    yield page
    page.close()
    session.close()


@pytest.fixture
def come(browser, served):
    """Lets someone open the page; all leave at the end."""
    context = browser.new_context(
        # A quarter of the pixels each way: they are drawn without a graphics card.
        viewport={"width": 1280, "height": 720},
        device_scale_factor=0.25,
    )
    context.set_default_timeout(1e3 * PATIENCE)
    yield lambda: Person(context, served)
    context.close()


class Person:
    """Someone at a page."""

    def __init__(self, context, served):
        self.served, self.session = served, served.session
        known = set(served._server.get_clients())
        self.page = context.new_page()
        self.page.goto(served.address)
        self.page.wait_for_selector(".mode")
        self.until(lambda: set(served._server.get_clients()) - known)
        self.number = max(served._server.get_clients())

    @property
    def now(self):
        return self.session.snapshot

    def until(self, condition):
        for _ in range(int(PATIENCE / 0.05)):
            if condition():
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"never came; said last: {self.now.said}")

    def says(self, text):
        self.until(lambda: text in self.page.locator(".said").inner_text())
        return self.page.locator(".said").inner_text()

    def button(self, name):
        return self.page.get_by_role("button", name=name)

    def at(self, point):
        """Where a point of the world is on the screen, pixels."""
        camera = self.served._server.get_clients()[self.number].camera
        w, x, y, z = camera.wxyz
        turned = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        across, down, ahead = turned.T @ (np.asarray(point) - camera.position)
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        box = self.page.locator("canvas").first.bounding_box()
        u = across / ahead * focal + camera.image_width / 2
        v = down / ahead * focal + camera.image_height / 2
        return box["x"] + u, box["y"] + v

    def drag(self, point, right, down, held=None):
        """Presses on a point of the world and drags; lets go when `held` came true."""
        x, y = self.at(point)
        mouse = self.page.mouse
        mouse.move(x, y)
        mouse.down()
        mouse.move(x + right / 2, y + down / 2)
        mouse.move(x + right, y + down)
        if held is not None:
            self.until(held)
        mouse.up()

    def patch(self, name):
        """The middle of a patch in the world."""
        env = self.session.lesson.env
        cells = cells_in_world(env.model, env.data, env.skin)
        return cells.positions[env.skin.slices[name]].mean(axis=0)

    def hand(self):
        return self.session.lesson.env.data.body("hand_palm_link").xpos.copy()


def drawn_bars(person):
    """Weights that the bars name, and their widths as they are drawn, shares of the whole."""
    bars = person.page.locator(".recall-bar")
    return bars.evaluate_all(
        "bars => bars.map(b => [+b.dataset.weight, "
        "b.firstElementChild.getBoundingClientRect().width / b.getBoundingClientRect().width])"
    )


def test_a_robot_is_taught_in_the_browser(come, tmp_path):
    me = come()
    assert "knows nothing" in me.page.locator(".mode").inner_text()
    fits = me.page.evaluate("document.documentElement.scrollHeight <= innerHeight")
    assert fits
    assert me.button("Let go (L)").bounding_box()["y"] < 690

    # Push: the cell lights up, the push stays, the empty robot does not move.
    start = me.now.state
    me.page.keyboard.down("Shift")
    me.drag(me.patch("wrist_upper"), 36, 48, held=lambda: me.now.cells.sum() > 5.0)
    me.page.keyboard.up("Shift")
    me.until(lambda: me.now.arrows and me.now.arrows[0].pinned)
    arrow = me.now.arrows[0]
    assert (arrow.patch, arrow.newtons) == ("wrist_upper", pytest.approx(6.0, abs=0.5))
    spikes = me.page.locator('.spikes[data-patch="wrist_upper"]')
    me.until(lambda: int(spikes.get_attribute("data-count")) > 10)
    np.testing.assert_allclose(me.now.state, start, atol=0.01)

    # Record: the gripper is dragged down while the patch is pushed. Keep.
    me.page.keyboard.press("r")
    me.until(lambda: me.now.mode == "record")
    high = me.hand()
    me.drag(high, 0, 70, held=lambda: me.hand()[2] < high[2] - 0.08)
    me.until(lambda: "Stop" in me.button("Stop (R)").inner_text())
    me.button("Keep (K)").click()
    assert "demonstration 0" in me.says("Learned")
    me.until(lambda: me.now.known == 1)
    shown = me.session._shown[0]

    # Save it as a dataset, which takes a while; the robot goes on meanwhile.
    me.page.get_by_role("tab", name="Files").click()
    me.page.locator("input[value=my_teaching]").fill("nod")
    me.page.keyboard.press("Tab")
    me.button("Save as LeRobot dataset").click()
    me.page.get_by_role("tab", name="Teach").click()

    # Play its touch: the robot answers by itself, and bars say why.
    me.button("Play its touch (P)").click()
    me.until(lambda: me.now.mode == "play" and me.now.why is not None)
    me.until(lambda: me.now.mode == "live")
    assert np.abs(me.now.state - shown.state[-1]).max() < 0.15
    me.until(lambda: drawn_bars(me))
    for weight, width in drawn_bars(me):
        assert width == pytest.approx(weight, abs=0.02)
    assert [w for w, _ in drawn_bars(me)] == pytest.approx(
        [reason.weight for reason in me.now.why.reasons], abs=1e-3
    )
    box = me.page.locator(".recall-bar").first.bounding_box()
    me.page.mouse.move(box["x"] + 20, box["y"] + 8)
    me.until(lambda: POSTURE in me.now.ghosts)

    # Save what it knows, forget, load.
    me.says("Saved 1 demonstrations")
    me.page.get_by_role("tab", name="Files").click()
    me.button("Save checkpoint").click()
    me.says("Saved what it knows")
    me.page.get_by_role("tab", name="Teach").click()
    me.button("Forget last (F)").click()
    me.says("Forgot demonstration 0")
    me.until(lambda: me.now.known == 0 and not drawn_bars(me))
    me.page.reload()
    me.page.wait_for_selector(".mode")
    me.until(lambda: "You drive" in me.page.locator(".seat").inner_text())
    me.page.get_by_role("tab", name="Files").click()
    me.button("Load").click()
    me.says("Loaded")
    me.until(lambda: me.now.known == 1)
    check_dataset(tmp_path / "datasets" / "nod", shown)


def check_dataset(root: Path, shown):
    """It loads with LeRobot's own loader and with train.py's, and holds what was shown."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    theirs = LeRobotDataset("local/nod", root=root, video_backend="pyav")
    assert (theirs.num_episodes, len(theirs), theirs.fps) == (1, len(shown), 50)
    frame = theirs[len(shown) // 2]
    np.testing.assert_array_equal(frame["observation.state"], shown.state[len(shown) // 2])
    ours = load_episodes(root)
    np.testing.assert_array_equal(ours.episodes[0].tactile, shown.tactile)
    np.testing.assert_array_equal(ours.episodes[0].action, shown.action)
    assert ours.joints == JOINTS
    assert train(root, HASMConfig(drive="spike")).model.patches == ["wrist_upper"]


def test_one_page_drives_and_another_takes_over(come):
    first, second = come(), come()
    first.until(lambda: "2 pages" in first.page.locator(".seat").inner_text())
    assert "You drive" in first.page.locator(".seat").inner_text()
    assert "Another page drives" in second.page.locator(".seat").inner_text()
    second.until(lambda: second.button("Record (R)").is_disabled())
    assert first.button("Record (R)").is_enabled()
    for key in "ru":
        second.page.keyboard.press(key)
    second.page.wait_for_timeout(300)
    assert (second.now.mode, second.now.arrows) == ("live", ())

    # The driver's page closes in the middle of a push: the finger lets go.
    first.page.keyboard.press("u")
    first.until(lambda: first.now.arrows)
    first.page.close()
    second.until(lambda: not second.now.arrows)
    second.button("Take over").click()
    second.until(lambda: "You drive" in second.page.locator(".seat").inner_text())
    second.until(lambda: second.button("Record (R)").is_enabled())
    second.page.keyboard.press("u")
    second.until(lambda: second.now.arrows)


def test_what_is_no_page_harms_nothing(come, served):
    me = come()
    address = served.address.replace("http", "ws")
    spoken = [f"viser-v{viser.__version__}"]
    for message in (b"\xff\x00nonsense", b"", "text", b"\x81\xa4type\xa4none"):
        with connect(address, subprotocols=spoken) as stranger:
            stranger.send(message)
            with suppress(ConnectionClosed):  # the stranger's, and nobody else's
                while stranger.recv(timeout=PATIENCE):
                    pass
    me.page.keyboard.press("u")
    me.until(lambda: me.now.arrows)
    assert "You drive" in me.page.locator(".seat").inner_text()
    assert served._server.request_share_url() is None


def test_the_command_serves_its_page(browser, tmp_path):
    options = ["--teach=empty", "--port=8795", f"--output_dir={tmp_path}"]
    program = [sys.executable, str(ROOT / "touch.py"), *options]
    with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
        line = running.stdout.readline()
        assert "http://127.0.0.1:8795" in line
        page = browser.new_page(device_scale_factor=0.25)
        page.goto("http://127.0.0.1:8795")
        page.wait_for_selector(".mode")
        page.keyboard.press("u")
        page.wait_for_function("document.querySelector('.spikes')?.dataset.count > 10")
        page.close()
        running.send_signal(signal.SIGINT)
        assert running.wait(PATIENCE) == 0


def test_it_listens_to_this_machine_alone(served):
    (listening,) = {
        line.split()[1].split(":")[0]
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
        if line.split()[3] == "0A" and int(line.split()[1].split(":")[1], 16) == 8790
    }
    assert listening == "0100007F"
